"""The finished surface: beside the truth, beside the photos, and what it costs."""
