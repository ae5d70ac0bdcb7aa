"""How well F explains all matches, and how probably each of them is an inlier (thesis 4.4.1, 4.6, 4.7)."""
