"""Formats for whole scenes: cameras, poses, points and photos for other programs."""
