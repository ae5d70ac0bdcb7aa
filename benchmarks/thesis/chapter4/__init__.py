"""Chapter 4: fundamental matrices."""
