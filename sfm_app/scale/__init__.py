"""Find the real size and place of a model: from known distances, printed markers, ground control points and GPS."""

from sfm_app.scale.control_file import read_control_points
from sfm_app.scale.evidence import GPS
from sfm_app.scale.metric_frame import IDENTITY, MetricFrame, move_model

__all__ = ["GPS", "IDENTITY", "MetricFrame", "move_model", "read_control_points"]
