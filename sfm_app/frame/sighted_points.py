"""Places in the model from their marks in photos, and distances between them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.colmap.backend import Reconstruction, translate_errors
from sfm_app.colmap.model import focal_px, posed_images, seen_points, viewing_rays
from sfm_app.types import Photo
from sfm_app.types.arrays import FloatArray

# Points that were marked in several photos, placed where their viewing rays meet.

MAX_RESIDUAL_PX = 6.0
"""Largest distance in pixels at which a photo agrees with a point: people mark to one or two pixels, and a marker that
is seen obliquely is found to one. Chosen by hand; a wrong mark is off by tens."""
LEAST_ANGLE_DEG = 1.0
"""Least angle between two rays that place a point. Chosen by hand: its depth is then sixty times less sure than its
direction."""
LEAST_SIGMA_PX = 0.1
"""Least standard deviation of a mark, in pixels: two photos agree by chance."""
MAX_STARTS = 300
"""Most pairs of rays that are tried."""
ROUNDS = 6


@dataclass(frozen=True, slots=True)
class Sight:
    """A point marked in one photo, as a ray in the model."""

    photo: str
    center: FloatArray
    """(3,) of the camera."""
    ray: FloatArray
    """(3,) unit vector towards the point."""
    focal_px: float
    """Pixels per radian there, about."""


@dataclass(frozen=True, slots=True, eq=False)
class SightedPoint:
    """A point in the model, and how well the photos determine it."""

    place: FloatArray
    """(3,)."""
    covariance: FloatArray
    """(3, 3), in squared units of the model."""
    residual_px: float
    """Root mean square distance of the marks from it."""
    photos: tuple[str, ...]
    left_out: tuple[str, ...]
    """Photos whose mark contradicts the others."""


def locate_point(sights: Sequence[Sight]) -> SightedPoint | str:
    """Place a point where most of its rays meet, by least squares of the distances in pixels; else say why not."""
    if len(sights) < 2:
        return "it is marked in one photo with a pose, two are needed" if sights else "no photo with it has a pose"
    centers, rays = np.array([one.center for one in sights]), np.array([one.ray for one in sights])
    focals = np.array([one.focal_px for one in sights])
    agreeing = _best_agreement(centers, rays, focals)
    if agreeing is None:
        return "its rays do not meet: they are almost parallel, or the marks contradict each other"
    for _ in range(3):
        place = _meet(centers[agreeing], rays[agreeing], focals[agreeing])
        after = _residuals_px(place, centers, rays, focals) < MAX_RESIDUAL_PX
        if after.sum() < 2 or (after == agreeing).all():
            break
        agreeing = after
    residuals = _residuals_px(place, centers, rays, focals)[agreeing]
    freedom = max(2 * len(residuals) - 3, 1)
    sigma = max(float(np.sqrt((residuals**2).sum() / freedom)), LEAST_SIGMA_PX)
    information = ray_information(place, centers[agreeing], rays[agreeing], focals[agreeing])
    return SightedPoint(
        place,
        np.asarray(sigma**2 * np.linalg.inv(information), np.float64),
        float(np.sqrt(np.mean(residuals**2))),
        tuple(one.photo for one, kept in zip(sights, agreeing, strict=True) if kept),
        tuple(one.photo for one, kept in zip(sights, agreeing, strict=True) if not kept),
    )


def ray_information(place: FloatArray, centers: FloatArray, rays: FloatArray, focals: FloatArray) -> FloatArray:
    """Return what rays tell of a point: the inverse of its covariance (3, 3) for marks that are exact to one pixel.

    Args:
        place: (3,) the point.
        centers: (N, 3) of the cameras.
        rays: (N, 3) unit vectors.
        focals: (N,) pixels per radian.
    """
    weights = (focals / np.maximum(np.linalg.norm(place - centers, axis=1), 1e-300)) ** 2
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.asarray((weights[:, None, None] * across).sum(axis=0))


def _best_agreement(centers: FloatArray, rays: FloatArray, focals: FloatArray) -> NDArray[np.bool_] | None:
    """Return the photos that agree with the best pair of rays; None where no pair meets in front of its cameras."""
    pairs = np.array(list(combinations(range(len(rays)), 2)), np.intp)
    if len(pairs) > MAX_STARTS:
        pairs = np.random.default_rng(0).permutation(pairs)[:MAX_STARTS]
    best, least = None, np.inf
    for pair in pairs:
        if np.linalg.norm(np.cross(*rays[pair])) < np.sin(np.radians(LEAST_ANGLE_DEG)):
            continue
        place = _meet(centers[pair], rays[pair], focals[pair])
        distances = _residuals_px(place, centers, rays, focals)
        cost = float((np.minimum(distances, MAX_RESIDUAL_PX) ** 2).sum())
        agreeing = distances < MAX_RESIDUAL_PX
        if cost < least and agreeing.sum() >= 2:
            best, least = agreeing, cost
    return best


def _meet(centers: FloatArray, rays: FloatArray, focals: FloatArray) -> FloatArray:
    """Return the point (3,) next to all rays: least squares, each weighted by its pixels per unit of length there."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    weights = np.ones(len(rays))
    for _ in range(ROUNDS):
        A = (weights[:, None, None] * across).sum(axis=0)
        b = np.einsum("n,nij,nj->i", weights, across, centers)
        place = np.linalg.lstsq(A, b, rcond=None)[0]
        weights = (focals / np.maximum(np.linalg.norm(place - centers, axis=1), 1e-300)) ** 2
        weights /= weights.max()
    return np.asarray(place)


def _residuals_px(place: FloatArray, centers: FloatArray, rays: FloatArray, focals: FloatArray) -> FloatArray:
    """Return (N,) angles between the rays and the point, in pixels."""
    towards = place - centers
    along = np.einsum("ni,ni->n", towards, rays)
    across = np.linalg.norm(np.cross(towards, rays), axis=1)
    return np.asarray(focals * np.arctan2(across, along))


# Distances in a finished model, with deviations.

NEIGHBORS = 12
"""Points of the sparse model next to a place whose photos are taken for those that show it. Chosen by hand."""
LEAST_PICKED_SIGMA_PX = 0.5
"""Least standard deviation of a place picked on a surface, in pixels."""


@dataclass(frozen=True, slots=True)
class Distance:
    """A distance between two places of a model."""

    value: float
    """In the unit of the exported files."""
    deviation: float
    """Standard deviation, in the same unit; without that of the unit where it is arbitrary."""
    metric: bool
    """Whether the unit is the meter."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {"distance": self.value, "deviation": self.deviation, "unit": "meter" if self.metric else "arbitrary"}


@dataclass(frozen=True, slots=True, eq=False)
class Sightlines:
    """The cameras of a model, and which of them see which points."""

    centers: FloatArray
    """(C, 3)."""
    focals: FloatArray
    """(C,) pixels per radian."""
    points: FloatArray
    """(P, 3)."""
    seen_by: tuple[NDArray[np.int64], ...]
    """For each point, the rows of the cameras that see it."""
    residual_px: float
    """Mean reprojection error."""


def place_covariance(place: FloatArray, model: Sightlines) -> FloatArray:
    """Return the covariance (3, 3) of a place on the surface, as the photos that see it determine it.

    Args:
        place: (3,) in the frame of the model.
    """
    near = np.argsort(np.linalg.norm(model.points - place, axis=1))[:NEIGHBORS]
    counts = np.bincount(np.concatenate([model.seen_by[k] for k in near]), minlength=len(model.centers))
    # as many photos as see one of the points, those that see most of them
    typical = max(int(np.median([len(model.seen_by[k]) for k in near])), 2)
    seeing = np.argsort(-counts, kind="stable")[:typical]
    towards = place - model.centers[seeing]
    rays = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-300)
    information = ray_information(place, model.centers[seeing], rays, model.focals[seeing])
    return np.asarray(max(model.residual_px, LEAST_PICKED_SIGMA_PX) ** 2 * np.linalg.pinv(information))


def measure_distance(
    a: FloatArray, b: FloatArray, model: Sightlines, scale: float, deviation: float | None
) -> Distance:
    """Return the distance between two places.

    Args:
        a, b: (3,) in the frame of the model.
        deviation: relative, of the scale; None where the unit is arbitrary.

    Raises:
        ValueError: both places are the same.
    """
    apart = float(np.linalg.norm(b - a))
    if apart == 0:
        raise ValueError("both places are the same")
    along = (b - a) / apart
    variance = along @ (place_covariance(a, model) + place_covariance(b, model)) @ along
    value = scale * apart
    spread = np.hypot(scale * np.sqrt(max(float(variance), 0.0)), value * (deviation or 0.0))
    return Distance(value, float(spread), deviation is not None)


# Viewing rays of marks in photos, and what the photos of a model see.

MOST_POINTS = 200_000
"""Most points of a model among which the nearest to a place are sought."""


class PosedPhotos:
    """The photos of a model on disk that have a pose.

    Raises:
        BackendError: it cannot be read.
    """

    def __init__(self, model_dir: Path) -> None:
        with translate_errors("reading the sparse model"):
            self._model = Reconstruction(model_dir)
            self._ids = {image.name: image.image_id for image in posed_images(self._model)}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the photos."""
        return tuple(self._ids)

    def __contains__(self, photo: str) -> bool:
        """Return whether a photo has a pose."""
        return photo in self._ids

    def sights(self, photo: str, pixels: FloatArray) -> list[Sight]:
        """Return the viewing rays of pixels.

        Args:
            pixels: (N, 2) as it is laid out; pixel centers at +0.5.
        """
        number = self._ids[photo]
        with translate_errors("looking along the pixels of a photo"):
            rays = viewing_rays(self._model, number, pixels)
            focal = focal_px(self._model, number)
            center = np.asarray(self._model.images[number].projection_center(), np.float64)
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return [Sight(photo, center, ray, focal) for ray in rays]

    def sightlines(self) -> Sightlines:
        """Return the cameras, and which of them see which points."""
        with translate_errors("reading the sparse model"):
            found = seen_points(self._model, MOST_POINTS)
            ids = list(self._ids.values())
            centers = np.array([self._model.images[number].projection_center() for number in ids], np.float64)
            focals = np.array([focal_px(self._model, number) for number in ids])
            residual = float(self._model.compute_mean_reprojection_error())
        cameras = np.concatenate([np.full(len(rows), k, np.int64) for k, rows in enumerate(found.seen)])
        rows = np.concatenate(found.seen)
        order = np.argsort(rows, kind="stable")
        ends = np.cumsum(np.bincount(rows, minlength=len(found.points)))[:-1]
        return Sightlines(centers, focals, found.points, tuple(np.split(cameras[order], ends)), residual)


def layout_scale(photo: Photo, folder: Path) -> float:
    """Return how much smaller a photo is laid out than its file: 1 where it has its full size, or the file is gone."""
    if not photo.needs_copy:
        return 1.0
    try:
        with Image.open(folder / photo.path) as image:
            return max(photo.width, photo.height) / max(image.size)
    except OSError:
        return 1.0


def unrotate_pixels(photo: Photo, upright: FloatArray) -> FloatArray:
    """Return pixels of the upright photo as pixels of the photo as it is laid out, in the sensor's orientation.

    Args:
        upright: (N, 2) x and y in the upright photo, at its laid-out size.
    """
    x, y = upright[:, 0], upright[:, 1]
    if photo.turn_deg == 90:
        return np.column_stack([y, photo.height - x])
    if photo.turn_deg == 180:
        return np.column_stack([photo.width - x, photo.height - y])
    if photo.turn_deg == 270:
        return np.column_stack([photo.width - y, x])
    return np.asarray(upright)


def named_photos(photos: tuple[Photo, ...]) -> Mapping[str, Photo]:
    """Return photos by every name that a user may give them: path in the folder, name, and file name where it is one.
    """
    files: dict[str, list[Photo]] = {}
    for photo in photos:
        files.setdefault(photo.path.rpartition("/")[2], []).append(photo)
    alone = {name: found[0] for name, found in files.items() if len(found) == 1}
    return alone | {photo.name: photo for photo in photos} | {photo.path: photo for photo in photos}
