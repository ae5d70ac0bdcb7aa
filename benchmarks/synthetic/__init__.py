"""Scenes, walks and matches with known truth, for benchmarks and tests."""
