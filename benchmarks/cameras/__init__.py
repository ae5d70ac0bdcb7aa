"""Cameras after bundle adjustment, beside stock pycolmap."""
