"""Real size by markers and ground control points, on rendered scenes."""
