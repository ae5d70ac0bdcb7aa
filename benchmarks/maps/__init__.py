"""Orthophotos and elevation models of rendered land, against the truth."""
