"""The page of a run, the figure of its cameras, and its results in words."""
