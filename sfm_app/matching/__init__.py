"""Features of photos, the pairs that are matched, and their matches."""
