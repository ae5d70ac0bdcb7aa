"""The K that most pairs agree on: thesis 5.8.4, carried to all of K at once."""
