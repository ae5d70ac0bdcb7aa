"""Surfaces too large for one reconstruction: cut into blocks, and joined along their faces."""
