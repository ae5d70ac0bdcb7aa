"""Figures and texts about the cameras of a run."""

from sfm_app.report.figures import check_figure, draw_intrinsics
from sfm_app.report.text import field_text, held_text, lens_text

__all__ = ["check_figure", "draw_intrinsics", "field_text", "held_text", "lens_text"]
