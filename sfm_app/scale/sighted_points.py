"""Points that were marked in several photos, placed where their viewing rays meet."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

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
    """Place a point where most of its rays meet, by least squares of the distances in pixels; else say why not.

    Args:
        sights: of one point, one per photo.
    """
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
