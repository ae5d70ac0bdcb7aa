"""Which photos are worth using: measured, compared, and left out."""
