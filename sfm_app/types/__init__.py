"""The products that stages pass on: frozen, picklable, numpy only.

Conventions:

- Pixels: the center of the top-left pixel is (0.5, 0.5), as in COLMAP. x runs right, y down.
- ``x2' F x1 = 0``: a fundamental matrix maps points of view 1 to epipolar lines of view 2.
- ``cam_from_world`` maps world points into the camera frame: x right, y down, z forward.
- Units are part of names: ``_px``, ``_deg``.
"""

from sfm_app.types.calibration import Calibration, Intrinsics
from sfm_app.types.camera_pairs import CameraPairs, PhotoPairs
from sfm_app.types.control_points import ControlPoint, ControlPoints
from sfm_app.types.epipolar import EpipolarFit, Rejected, ViewGraph
from sfm_app.types.exported import SceneArrays
from sfm_app.types.features import Features
from sfm_app.types.given_cameras import GivenCameras
from sfm_app.types.matches import MatchedImage, MatchGraph, PairId
from sfm_app.types.model import Frustum, Model, Texture
from sfm_app.types.photos import Frame, GpsPosition, Photo, PhotoSet, UnusablePhoto
from sfm_app.types.pose_graph import LookAlikes, PoseGraph, RelativePose
from sfm_app.types.scene import CameraModel, Scene
from sfm_app.types.surface import Surface

__all__ = [
    "Calibration",
    "CameraModel",
    "CameraPairs",
    "ControlPoint",
    "ControlPoints",
    "EpipolarFit",
    "Features",
    "Frame",
    "Frustum",
    "GivenCameras",
    "GpsPosition",
    "Intrinsics",
    "LookAlikes",
    "MatchGraph",
    "MatchedImage",
    "Model",
    "PairId",
    "Photo",
    "PhotoPairs",
    "PhotoSet",
    "PoseGraph",
    "Rejected",
    "RelativePose",
    "Scene",
    "SceneArrays",
    "Surface",
    "Texture",
    "UnusablePhoto",
    "ViewGraph",
]
