"""Surfaces compared with the scan of a depth camera."""
