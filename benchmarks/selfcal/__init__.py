"""The camera matrix before bundle adjustment, beside COLMAP and the methods of the thesis."""
