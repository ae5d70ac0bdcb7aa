"""Model files in viewers and readers."""
