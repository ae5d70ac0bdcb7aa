"""The products that stages pass on: frozen, picklable, numpy only.

Conventions:

- Pixels: the center of the top-left pixel is (0.5, 0.5), as in COLMAP. x runs right, y down.
- ``x2' F x1 = 0``: a fundamental matrix maps points of view 1 to epipolar lines of view 2.
- ``cam_from_world`` maps world points into the camera frame: x right, y down, z forward.
- Units are part of names: ``_px``, ``_deg``.
"""

from sfm_app.types.camera import Calibration, GivenCameras, Intrinsics
from sfm_app.types.evidence import (
    CameraPairs,
    EpipolarFit,
    EpipolarGeometry,
    Evidence,
    LookAlikes,
    PhotoPairs,
    PoseGraph,
    RayFit,
    Rejected,
    RelativePose,
    ViewGraph,
)
from sfm_app.types.photos import (
    CameraPrior,
    Features,
    Frame,
    GpsPosition,
    MatchedImage,
    MatchGraph,
    PairId,
    Photo,
    PhotoSet,
    UnusablePhoto,
)
from sfm_app.types.scene import CameraModel, ControlPoint, ControlPoints, MapPlace, PosedPhoto, Scene, SceneArrays
from sfm_app.types.surface import Model, Surface, Texture

__all__ = [
    "Calibration",
    "CameraModel",
    "CameraPairs",
    "CameraPrior",
    "ControlPoint",
    "ControlPoints",
    "EpipolarFit",
    "EpipolarGeometry",
    "Evidence",
    "Features",
    "Frame",
    "GivenCameras",
    "GpsPosition",
    "Intrinsics",
    "LookAlikes",
    "MapPlace",
    "MatchGraph",
    "MatchedImage",
    "Model",
    "PairId",
    "Photo",
    "PhotoPairs",
    "PhotoSet",
    "PoseGraph",
    "PosedPhoto",
    "RayFit",
    "Rejected",
    "RelativePose",
    "Scene",
    "SceneArrays",
    "Surface",
    "Texture",
    "UnusablePhoto",
    "ViewGraph",
]
