"""A town of streets and houses, and photos of a walk through it."""
