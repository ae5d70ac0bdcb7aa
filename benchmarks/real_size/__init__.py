"""Real size by markers, known distances and ground control points, on rendered scenes."""
