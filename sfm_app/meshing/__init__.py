"""From a raw surface to a clean mesh: confirmed by photos, with smooth borders, manifold and colored."""
