"""Panoramas: how they are recognized, and the perspective views through which they are used."""
