"""What people look at: figures of what a run found, and the words for them."""

from sfm_app.report.calibration_figure import check_figure, draw_intrinsics

__all__ = ["check_figure", "draw_intrinsics"]
