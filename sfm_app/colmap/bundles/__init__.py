"""Parts of the last bundle adjustment: models as arrays, its rounds, the choice of the lens, and rolling shutters."""
