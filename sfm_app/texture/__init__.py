"""Texture of a surface, from the photos that show it best."""
