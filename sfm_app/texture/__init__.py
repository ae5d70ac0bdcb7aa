"""Pictures for the triangles of a surface, from the photos that see them."""
