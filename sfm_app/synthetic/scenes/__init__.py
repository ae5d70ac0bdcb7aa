"""What is rendered: scenes of known shape."""
