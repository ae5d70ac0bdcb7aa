"""Features, matches, fundamental matrices and cameras by the chosen methods, and diagnoses of unusable photos."""
