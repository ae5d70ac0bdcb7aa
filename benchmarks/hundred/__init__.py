"""Time and memory of hundreds of photos."""
