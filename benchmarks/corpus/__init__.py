"""Every photo set, as it is and changed, beside stock pycolmap."""
