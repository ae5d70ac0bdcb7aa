"""What comes after the result: a picture in the terminal, and what to do next."""
