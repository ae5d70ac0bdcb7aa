"""COLMAP's sparse models: built, divided, joined, and read from the disk."""
