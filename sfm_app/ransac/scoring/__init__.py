"""How well F explains all matches, and what that says about each of them (thesis 4.4.1, 4.6, 4.7)."""
