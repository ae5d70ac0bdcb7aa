"""Frames of a video that become photos."""
