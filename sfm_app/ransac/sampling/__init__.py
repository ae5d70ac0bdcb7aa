"""Which matches are drawn (thesis 4.4.3), and how often (thesis 3.3.6, 4.4.5, 4.7.4)."""
