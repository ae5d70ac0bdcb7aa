"""Rendered folders with random trouble."""
