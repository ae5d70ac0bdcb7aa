"""Cameras adjusted to the matches of pairs, and how far to trust them. Ours."""
