"""From a raw surface to a clean mesh: confirmed by photos, with smooth borders, manifold and colored."""

from sfm_app.meshing.cleaning import (
    Support,
    bridge_gaps,
    cut,
    drop_doubtful_parts,
    drop_islands,
    make_manifold,
    smooth_support,
    trim,
)
from sfm_app.meshing.visibility import (
    CONFIRMED,
    EMPTY,
    NO_EVIDENCE,
    SEEN_THROUGH,
    DepthView,
    Paint,
    judge,
    sample_colors,
)

__all__ = [
    "CONFIRMED",
    "EMPTY",
    "NO_EVIDENCE",
    "SEEN_THROUGH",
    "DepthView",
    "Paint",
    "Support",
    "bridge_gaps",
    "cut",
    "drop_doubtful_parts",
    "drop_islands",
    "judge",
    "make_manifold",
    "sample_colors",
    "smooth_support",
    "trim",
]
