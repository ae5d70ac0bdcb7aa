"""Thousands of photos: what a run costs, and what is lost by not matching all pairs."""
