"""Places in the model from their marks in photos, and distances between them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sfm_app.colmap.backend import Reconstruction, translate_errors
from sfm_app.colmap.model import focal_px, posed_images, seen_points, viewing_rays
from sfm_app.geometry.poses import draw_pairs
from sfm_app.types import Photo
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray


class OPTIONS:
    """Constants of points in the model, by their marks in photos."""

    max_residual_px: float = 6.0
    """Largest residual of an inlier: people mark to one or two pixels, a marker that is seen obliquely is found to
    one. Chosen by hand; a wrong mark is off by tens."""
    min_angle_deg: float = 1.0
    """Least angle between two rays that place a point. Chosen by hand: its depth is then sixty times less sure than its
    direction."""
    min_sigma_px: float = 0.1
    """Least standard deviation of a mark: two photos agree by chance. Chosen by hand."""
    max_pairs: int = 300
    rounds: int = 6
    neighbors: int = 12
    """Nearest points of the sparse model whose photos are taken to see a place. Chosen by hand."""
    min_picked_sigma_px: float = 0.5
    """Least standard deviation of a place picked on a surface. Chosen by hand."""
    max_points: int = 200_000
    """Largest number of points of a model among which the nearest to a place are sought."""


@dataclass(frozen=True, slots=True)
class Sight:
    """A point marked in one photo, as a ray in the model."""

    photo: str
    center: FloatArray
    """(3,) of the camera."""
    ray: FloatArray
    """(3,) unit vector towards the point."""
    focal_px: float
    """Approximate pixels per radian at the mark."""


@dataclass(frozen=True, slots=True, eq=False)
class SightedPoint:
    """A point in the model by its marks in photos."""

    place: FloatArray
    """(3,)."""
    covariance: FloatArray
    """(3, 3), in squared units of the model."""
    photos: tuple[str, ...]
    outliers: tuple[str, ...]
    """Photos whose mark contradicts the others."""
    sigma_px: float = 1.0
    """Standard deviation of a mark that the covariance assumes: two photos may agree by chance."""


def locate_point(sights: Sequence[Sight]) -> SightedPoint | str:
    """Place a point by its sights, one per photo, by least squares without outliers; return the reason if it fails."""
    if len(sights) < 2:
        return "it is marked in one photo with a pose, two are needed" if sights else "no photo with it has a pose"
    centers, rays = np.array([one.center for one in sights]), np.array([one.ray for one in sights])
    focals = np.array([one.focal_px for one in sights])
    inliers = _inliers_of_pairs(centers, rays, focals)
    if inliers is None:
        return "its rays do not meet: they are almost parallel, or the marks contradict each other"
    for _ in range(3):
        place = _intersect(centers[inliers], rays[inliers], focals[inliers])
        refitted = _residuals_px(place, centers, rays, focals) < OPTIONS.max_residual_px
        if refitted.sum() < 2 or (refitted == inliers).all():
            break
        inliers = refitted
    residuals = _residuals_px(place, centers, rays, focals)[inliers]
    freedom = max(2 * len(residuals) - 3, 1)
    sigma = max(float(np.sqrt((residuals**2).sum() / freedom)), OPTIONS.min_sigma_px)
    information = ray_information(place, centers[inliers], rays[inliers], focals[inliers])
    return SightedPoint(
        place,
        np.asarray(sigma**2 * np.linalg.inv(information), np.float64),
        tuple(one.photo for one, inlier in zip(sights, inliers, strict=True) if inlier),
        tuple(one.photo for one, inlier in zip(sights, inliers, strict=True) if not inlier),
        sigma,
    )


def ray_information(place: FloatArray, centers: FloatArray, rays: FloatArray, focals: FloatArray) -> FloatArray:
    """Return the information matrix (3, 3) of a point for marks with a deviation of one pixel, by unit rays."""
    weights = (focals / np.maximum(np.linalg.norm(place - centers, axis=1), 1e-300)) ** 2
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.asarray((weights[:, None, None] * across).sum(axis=0))


def _inliers_of_pairs(centers: FloatArray, rays: FloatArray, focals: FloatArray) -> BoolArray | None:
    """Return the inliers (N,) of the best pair of rays; None if no pair meets in front of its cameras."""
    best, least = None, np.inf
    for pair in draw_pairs(len(rays), OPTIONS.max_pairs):
        if np.linalg.norm(np.cross(*rays[pair])) < np.sin(np.radians(OPTIONS.min_angle_deg)):
            continue
        place = _intersect(centers[pair], rays[pair], focals[pair])
        residuals = _residuals_px(place, centers, rays, focals)
        cost = float((np.minimum(residuals, OPTIONS.max_residual_px) ** 2).sum())
        inliers = residuals < OPTIONS.max_residual_px
        if cost < least and inliers.sum() >= 2:
            best, least = inliers, cost
    return best


def _intersect(centers: FloatArray, rays: FloatArray, focals: FloatArray) -> FloatArray:
    """Return the point (3,) nearest to all rays: least squares, weighted by pixels per unit of length at the point."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    weights = np.ones(len(rays))
    for _ in range(OPTIONS.rounds):
        A = (weights[:, None, None] * across).sum(axis=0)
        b = np.einsum("n,nij,nj->i", weights, across, centers)
        place = np.linalg.lstsq(A, b, rcond=None)[0]
        weights = (focals / np.maximum(np.linalg.norm(place - centers, axis=1), 1e-300)) ** 2
        weights /= weights.max()
    return np.asarray(place)


def _residuals_px(place: FloatArray, centers: FloatArray, rays: FloatArray, focals: FloatArray) -> FloatArray:
    """Return the angles (N,) between the rays and the point, in pixels."""
    towards = place - centers
    along = np.einsum("ni,ni->n", towards, rays)
    across = np.linalg.norm(np.cross(towards, rays), axis=1)
    return np.asarray(focals * np.arctan2(across, along))


@dataclass(frozen=True, slots=True)
class Distance:
    """A distance between two places of a model."""

    value: float
    """In the unit of the exported files."""
    deviation: float
    """Standard deviation in the same unit; excludes the deviation of an arbitrary unit."""
    metric: bool
    """Whether the unit is the meter."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {"distance": self.value, "deviation": self.deviation, "unit": "meter" if self.metric else "arbitrary"}


@dataclass(frozen=True, slots=True, eq=False)
class Sightlines:
    """The cameras of a model and the points they see."""

    centers: FloatArray
    """(C, 3)."""
    focals: FloatArray
    """(C,) pixels per radian."""
    points: FloatArray
    """(P, 3)."""
    seen_by: tuple[IndexArray, ...]
    """For each point, the indices of the cameras that see it."""
    residual_px: float
    """Mean reprojection error."""


def place_covariance(place: FloatArray, model: Sightlines) -> FloatArray:
    """Return the covariance (3, 3) of a place (3,) on the surface from the photos that see it."""
    near = np.argsort(np.linalg.norm(model.points - place, axis=1))[: OPTIONS.neighbors]
    counts = np.bincount(np.concatenate([model.seen_by[k] for k in near]), minlength=len(model.centers))
    # as many photos as see a typical neighbor: those that see most neighbors
    typical = max(int(np.median([len(model.seen_by[k]) for k in near])), 2)
    seeing = np.argsort(-counts, kind="stable")[:typical]
    towards = place - model.centers[seeing]
    rays = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-300)
    information = ray_information(place, model.centers[seeing], rays, model.focals[seeing])
    return np.asarray(max(model.residual_px, OPTIONS.min_picked_sigma_px) ** 2 * np.linalg.pinv(information))


def measure_distance(
    a: FloatArray, b: FloatArray, model: Sightlines, scale: float, deviation: float | None
) -> Distance:
    """Return the distance between two places (3,) in the frame of the model; a ValueError says that they are the same.

    `scale` is in units of exported files per unit of the model, with a relative `deviation`, None if arbitrary.
    """
    length = float(np.linalg.norm(b - a))
    if length == 0:
        raise ValueError("both places are the same")
    direction = (b - a) / length
    variance = direction @ (place_covariance(a, model) + place_covariance(b, model)) @ direction
    value = scale * length
    spread = np.hypot(scale * np.sqrt(max(float(variance), 0.0)), value * (deviation or 0.0))
    return Distance(value, float(spread), deviation is not None)


class PosedPhotos:
    """The posed photos of a COLMAP model on disk; raises a BackendError if the model cannot be read."""

    def __init__(self, model_dir: Path) -> None:
        with translate_errors("reading the sparse model"):
            self._model = Reconstruction(model_dir)
            self._ids = {image.name: image.image_id for image in posed_images(self._model)}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the photos."""
        return tuple(self._ids)

    def __contains__(self, photo: str) -> bool:
        return photo in self._ids

    def sights(self, photo: str, pixels: FloatArray) -> list[Sight]:
        """Return the viewing rays of pixels (N, 2) of a laid-out photo, pixel centers at +0.5."""
        number = self._ids[photo]
        with translate_errors("computing viewing rays"):
            rays = viewing_rays(self._model, number, pixels)
            focal = focal_px(self._model, number)
            center = np.asarray(self._model.images[number].projection_center(), np.float64)
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return [Sight(photo, center, ray, focal) for ray in rays]

    def sightlines(self) -> Sightlines:
        """Return the cameras and the points they see."""
        with translate_errors("reading the sparse model"):
            visible = seen_points(self._model, OPTIONS.max_points)
            ids = list(self._ids.values())
            centers = np.array([self._model.images[number].projection_center() for number in ids], np.float64)
            focals = np.array([focal_px(self._model, number) for number in ids])
            residual = float(self._model.compute_mean_reprojection_error())
        cameras = np.concatenate([np.full(len(rows), k, np.int64) for k, rows in enumerate(visible.seen)])
        rows = np.concatenate(visible.seen)
        order = np.argsort(rows, kind="stable")
        ends = np.cumsum(np.bincount(rows, minlength=len(visible.points)))[:-1]
        return Sightlines(centers, focals, visible.points, tuple(np.split(cameras[order], ends)), residual)


def layout_scale(photo: Photo, folder: Path) -> float:
    """Return the size of a laid-out photo relative to its file in a folder; 1 if the file is gone."""
    if not photo.needs_copy:
        return 1.0
    try:
        with Image.open(folder / photo.path) as image:
            return max(photo.width, photo.height) / max(image.size)
    except OSError:
        return 1.0


def unrotate_pixels(photo: Photo, upright: FloatArray) -> FloatArray:
    """Return pixels (N, 2) of the upright photo as pixels of the laid-out photo, in the sensor's orientation."""
    x, y = upright[:, 0], upright[:, 1]
    if photo.turn_deg == 90:
        return np.column_stack([y, photo.height - x])
    if photo.turn_deg == 180:
        return np.column_stack([photo.width - x, photo.height - y])
    if photo.turn_deg == 270:
        return np.column_stack([photo.width - y, x])
    return np.asarray(upright)


def named_photos(photos: tuple[Photo, ...]) -> Mapping[str, Photo]:
    """Return photos by path in the folder, by name, and by file name if it is unique."""
    files: dict[str, list[Photo]] = {}
    for photo in photos:
        files.setdefault(photo.path.rpartition("/")[2], []).append(photo)
    unique = {name: group[0] for name, group in files.items() if len(group) == 1}
    return unique | {photo.name: photo for photo in photos} | {photo.path: photo for photo in photos}
