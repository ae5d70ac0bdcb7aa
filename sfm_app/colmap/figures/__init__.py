"""Figures of a finished model."""
