"""Define the synthetic scenes."""
