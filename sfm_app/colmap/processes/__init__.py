"""Parts of COLMAP that run in separate processes."""
