"""Orthophotos and elevation models of finished runs, on the ground and on walls; nothing below imports it."""
