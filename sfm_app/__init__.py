"""sfm_app."""
