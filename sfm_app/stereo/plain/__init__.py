"""Plain areas, where matching finds nothing: what has a surface there, and where it is."""
