"""Depth maps fused, meshed and refined block by block, each block a task with its data in files."""
