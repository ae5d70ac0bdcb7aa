"""Which pairs of photos are worth matching, from the photos themselves."""
