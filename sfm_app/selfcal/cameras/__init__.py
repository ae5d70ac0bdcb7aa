"""Which photos of a set share a camera. Ours."""
