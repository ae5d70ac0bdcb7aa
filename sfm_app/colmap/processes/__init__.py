"""Parts of COLMAP that run as processes of their own."""
