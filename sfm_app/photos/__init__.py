"""Read folders of photos and videos: which files and frames are usable photos, and their metadata."""
