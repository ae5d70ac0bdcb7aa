"""The only package that talks to COLMAP."""
