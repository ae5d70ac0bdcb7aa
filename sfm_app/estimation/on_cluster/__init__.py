"""Work of this package that is cut up for the workers of a cluster."""
