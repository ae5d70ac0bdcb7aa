"""Depth maps of many photos, fused and meshed block by block; each block is a task with its data in files."""
