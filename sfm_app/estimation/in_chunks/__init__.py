"""Work of this package that is cut up for several processes."""
