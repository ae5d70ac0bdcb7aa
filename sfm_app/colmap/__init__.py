"""The only package that talks to COLMAP; BackendError where COLMAP fails, or cannot read or write a file."""
