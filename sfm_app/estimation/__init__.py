"""Fundamental matrices and cameras of all photos, and diagnoses of unusable photos."""
