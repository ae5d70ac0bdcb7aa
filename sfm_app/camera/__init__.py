"""One camera: its models, projection and back-projection."""
