"""Running stages: which are up to date, how they get their inputs, and what interfered with them."""
