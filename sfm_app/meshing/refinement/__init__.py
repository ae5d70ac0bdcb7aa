"""Move a surface to where the photos agree best; detail that depth maps smooth over comes back."""

from sfm_app.meshing.refinement.photo_levels import RefinePhoto
from sfm_app.meshing.refinement.refine import STEPS, Refinement, Spread, refine

__all__ = ["STEPS", "RefinePhoto", "Refinement", "Spread", "refine"]
