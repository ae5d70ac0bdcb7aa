"""From a raw surface to a clean mesh: confirmed by photos, with smooth borders, manifold and colored."""

from sfm_app.meshing.components import drop_islands
from sfm_app.meshing.manifold import make_manifold
from sfm_app.meshing.trimming import Support, bridge_gaps, cut, drop_doubtful_parts, smooth_support, trim
from sfm_app.meshing.vertex_colors import Paint, sample_colors
from sfm_app.meshing.visibility import CONFIRMED, EMPTY, NO_EVIDENCE, SEEN_THROUGH, DepthView, judge

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
