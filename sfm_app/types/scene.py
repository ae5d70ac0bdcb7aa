"""A COLMAP model with its figures, control points, and the arrays of exporters."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from sfm_app.types.arrays import ByteArray, FloatArray, IndexArray


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    """One camera after bundle adjustment."""

    model: str
    """COLMAP's name of the camera model: OPENCV, FULL_OPENCV, OPENCV_FISHEYE, THIN_PRISM_FISHEYE, EQUIRECTANGULAR."""
    params: tuple[float, ...]
    """COLMAP's parameters of that model."""
    K: FloatArray
    width: int
    height: int
    deviations: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations: "fx", "fy", "cx", "cy" in pixels, and the others by COLMAP's names; none of a panorama."""
    determined: tuple[str, ...] = ()
    """Parameters that photos determine besides the focal: "center", "aspect", "k1", ...; others kept their values."""
    correlations: Mapping[str, float] = field(default_factory=dict)
    """Correlations of the parameters in `deviations`, from -1 to 1, by two names with a space between: "fx k1"."""

    @property
    def focal_doubt(self) -> float:
        """Standard deviation of the focal length as a share of it; 0 if none is stated."""
        return max(self.deviations.get(name, 0.0) / float(self.K[k, k]) for k, name in enumerate(("fx", "fy")))

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        plain = {field.name: getattr(self, field.name) for field in fields(self)}
        return plain | {"K": self.K.tolist(), "params": list(self.params), "determined": list(self.determined)}


@dataclass(frozen=True, slots=True, eq=False)
class PosedPhoto:
    """A photo with a pose, without distortion: x ~ K (R X + t), pixel centers at +0.5."""

    name: str
    K: FloatArray
    """(3, 3) camera matrix in pixels; rows and columns may have different focal lengths, skew is allowed."""
    cam_from_world: FloatArray
    """(3, 4) [R | t]; x right, y down, z forward."""
    width: int
    height: int

    @property
    def R(self) -> FloatArray:
        """(3, 3) rotation of cam_from_world."""
        return self.cam_from_world[:, :3]

    @property
    def t(self) -> FloatArray:
        """(3,) translation of cam_from_world."""
        return self.cam_from_world[:, 3]

    @property
    def center(self) -> FloatArray:
        """(3,) center of projection in the world."""
        return camera_center(self.cam_from_world)

    @property
    def axis(self) -> FloatArray:
        """(3,) unit vector of the optical axis in the world."""
        return self.cam_from_world[2, :3]

    @property
    def projection(self) -> FloatArray:
        """(3, 4) K [R | t]; its last row gives the depth."""
        return self.K @ self.cam_from_world

    @property
    def focal_px(self) -> float:
        """Pixels per unit of length at depth 1, the mean of both directions."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    @property
    def widest_angle(self) -> float:
        """Upper bound in radians of the angle between the axis and the rays of the photo."""
        corners = np.array([[x, y] for x in (-1.0, self.width + 1.0) for y in (-1.0, self.height + 1.0)])
        rays = self.rays(corners)
        return float(np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2]).max())

    def depths(self, points: FloatArray) -> FloatArray:
        """Return (N,) the depths along the optical axis of points (N, 3) in the world."""
        return np.asarray(points @ self.R[2] + self.t[2])

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Return the rays (..., 3) of pixels (..., 2) in the frame of the camera, at depth 1."""
        homogeneous = np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1)
        return np.asarray(homogeneous @ np.linalg.inv(self.K).T)

    def resize(self, width: int, height: int) -> Self:
        """Return the photo at another size in pixels."""
        K = np.diag([width / self.width, height / self.height, 1.0]) @ self.K
        return replace(self, K=K, width=width, height=height)


def camera_center(cam_from_world: FloatArray) -> FloatArray:
    """Return (3,) the center of projection in the world of a camera with the pose [R | t] (3, 4)."""
    return -cam_from_world[:, :3].T @ cam_from_world[:, 3]


@dataclass(frozen=True, slots=True)
class MapPlace:
    """Where a frame in meters with y up lies on Earth."""

    system: str
    """Coordinate system of the origin, as the user named it."""
    origin: tuple[float, float, float]
    """Position of (0, 0, 0) in that system, east or longitude first."""
    heading_deg: float = 0.0
    """Direction of -z, clockwise from north, or from the north of a conformal grid."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A COLMAP model on disk, with the figures of its summary."""

    model_dir: Path
    cam_from_world: Mapping[str, FloatArray]
    """By name of a photo that has a pose: (3, 4) [R | t]."""
    unregistered: Mapping[str, str]
    """Names of the photos without a pose, with the reason."""
    cameras: Mapping[str, CameraModel]
    """By name, as in `Intrinsics`."""
    points: int
    observations: int
    mean_reprojection_px: float
    camera_of: Mapping[str, str] = field(default_factory=dict)
    """Name of the camera by photo that has a pose."""
    gps_deviation: float | None = None
    """Relative standard deviation of the unit where GPS makes it the meter; None: the unit is arbitrary."""
    gps_place: MapPlace | None = None
    """Place of the model by GPS."""

    @property
    def registered(self) -> tuple[str, ...]:
        """Names of the photos that have a pose."""
        return tuple(self.cam_from_world)


@dataclass(frozen=True, slots=True)
class ControlPoint:
    """A point of known position, and its pixels in photos."""

    name: str
    position: tuple[float, float, float]
    """In the units of the file's coordinate system: x, y and z, or longitude, latitude and height."""
    marks: Mapping[str, tuple[float, float]]
    """By photo: x and y in pixels of the upright photo at its full size; pixel centers at +0.5."""

    @property
    def is_check(self) -> bool:
        """Whether the point only checks the model: its name begins with CHK-, as for OpenDroneMap."""
        return self.name.casefold().startswith("chk-")


@dataclass(frozen=True, slots=True)
class ControlPoints:
    """Contents of a file of ground control points; falsy where none was given."""

    points: tuple[ControlPoint, ...] = ()
    crs: str = ""
    """Coordinate system, as the file names it."""
    source: str = ""
    """Path of the file, for people."""
    digest: str = ""
    """Hash of the contents; empty without a file."""

    def __bool__(self) -> bool:
        return bool(self.points)


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Colored points in the frame of the export."""

    points: FloatArray
    """(P, 3)"""
    colors: ByteArray
    """(P, 3) RGB."""
    normals: FloatArray | None = None
    """(P, 3) unit vectors; None where unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class PerspectivePhoto(PosedPhoto):
    """An undistorted photo, or one of several perspective views into a photo of a wide lens, in the export's frame.

    Its name is that of its file: letters, digits, - and _, then .jpg, without folders.
    """

    photo: str
    """Name of the photo that it shows."""
    mask: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class SceneArrays:
    """Poses, cameras, points and tracks of a finished run, in the frame of its exported files, with y up.

    Photos are counted by N, points by P, and observations, which are the members of all tracks, by M.
    """

    photos: tuple[str, ...]
    """(N) names of the photos that have a pose."""
    cam_from_world: FloatArray
    """(N, 3, 4) [R | t]; x right, y down, z forward in the camera."""
    K: FloatArray
    """(N, 3, 3) camera matrix of each photo in pixels; pixel centers at +0.5."""
    sizes: IndexArray
    """(N, 2) width and height in pixels."""
    points: FloatArray
    """(P, 3)."""
    colors: ByteArray
    """(P, 3) RGB."""
    errors_px: FloatArray
    """(P,) mean reprojection error of each point."""
    track_points: IndexArray
    """(M,) row of the point of each observation, ascending."""
    track_photos: IndexArray
    """(M,) row of its photo."""
    track_pixels: FloatArray
    """(M, 2) pixels of the keypoints, with the distortion of the lens."""
    metric: bool
    """Whether the unit is the meter."""

    @property
    def centers(self) -> FloatArray:
        """(N, 3) centers of projection in the world."""
        R, t = self.cam_from_world[:, :, :3], self.cam_from_world[:, :, 3]
        return np.asarray(-np.einsum("nji,nj->ni", R, t))
