"""The frame of the model: up, place, and size."""
