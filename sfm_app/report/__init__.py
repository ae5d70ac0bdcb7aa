"""The page of a run, the figure of its cameras, and its results in words."""

from sfm_app.report.figures import check_figure, draw_intrinsics
from sfm_app.report.text import field_text, held_text, lens_text

__all__ = ["check_figure", "draw_intrinsics", "field_text", "held_text", "lens_text"]
