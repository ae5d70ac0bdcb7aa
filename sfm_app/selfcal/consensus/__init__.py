"""The K that most pairs agree on: thesis 5.8.4, extended to all of K at once."""
