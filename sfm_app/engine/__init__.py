"""Running stages: their order, skipping, resuming, and measuring."""
