"""A finished model as pinhole cameras at full size, for other programs."""
