"""New photos in a model that is there."""
