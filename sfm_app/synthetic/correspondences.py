"""Correspondences with known truth: the image pairs of thesis section 4.8 and the five-view tracks of section 5.5.3.

ConfigError for options out of range, or without a convergent setup of cameras.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sfm_app.camera.models import camera_matrix
from sfm_app.errors import ConfigError
from sfm_app.geometry.epipolar import fundamental_from_pose
from sfm_app.synthetic.cameras import axis_rotation, check_ranges
from sfm_app.types.arrays import BoolArray, FloatArray

Poses = tuple[FloatArray, FloatArray]

DEPTHS = (0.6, 1.6)
"""Range of depths from the first camera, in distances to the middle of the scene."""
MAX_SETUPS = 10_000
"""Most draws of a setup of cameras."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairOptions:
    """A random image pair; the defaults are those of thesis section 4.8."""

    points: int = 1200
    """Matches, >= 8."""
    outliers: float = 0.0
    """Share of the matches that are wrong, in [0, 1)."""
    sigma_px: float = 1.0
    """Standard deviation of the Gaussian noise on every coordinate, in pixels, >= 0."""
    outlier_range_px: float = 256.0
    """Outliers are off by a uniform value in [-range, range] in x and in y, in pixels, > 0; our choice."""
    width: int = 512
    height: int = 512
    focal_px: float = 700.0
    max_rotation_deg: float = 60.0
    """Largest rotation between the cameras, about a random axis, in degrees, (0, 180]."""
    max_baseline: float = 1.0
    """Largest distance between the cameras, as a share of the distance to the middle of the scene, (0, 3]."""

    def __post_init__(self) -> None:
        check_ranges(
            "synthetic correspondences",
            points=self.points >= 8,
            outliers=0 <= self.outliers < 1,
            sigma_px=0 <= self.sigma_px < math.inf,
            outlier_range_px=0 < self.outlier_range_px < math.inf,
            size=min(self.width, self.height) >= 16,
            focal_px=0 < self.focal_px < math.inf,
            max_rotation_deg=0 < self.max_rotation_deg <= 180,
            max_baseline=0 < self.max_baseline <= 3,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackOptions:
    """Tracks through several cameras of one K; the defaults are those of thesis section 5.5.3."""

    cameras: int = 5
    """>= 2."""
    points: int = 200
    """Points that every camera sees, >= 8."""
    sigma_px: float = 1.0
    """Standard deviation of the Gaussian noise on every coordinate, in pixels, >= 0."""
    corrupted_pairs: int = 0
    """Number of pairs whose matches get outliers; the thesis corrupts 2 of 10."""
    outliers: float = 0.3
    """Share of wrong matches in the corrupted pairs, in [0, 1)."""
    outlier_range_px: float = 256.0
    other_focal: float = 1.0
    """Focal length of the last camera over that of the others; 1: all cameras share K. In [0.2, 5]."""
    width: int = 512
    height: int = 512
    focal_px: tuple[float, float] = (500.0, 1000.0)
    """Range of fx, in pixels."""
    aspect: tuple[float, float] = (0.8, 1.2)
    """Range of fy / fx."""
    center_offset: float = 0.1
    """Largest offset of the optical center from the middle, as a share of width and height, in [0, 0.4]."""
    max_rotation_deg: float = 30.0
    """Largest rotation of a camera away from the common start, in degrees, (0, 90]."""
    max_shift: float = 0.6
    """Largest shift of a camera away from the common start, as a share of the distance to the scene, (0, 2]."""

    def __post_init__(self) -> None:
        check_ranges(
            "synthetic correspondences",
            cameras=self.cameras >= 2,
            points=self.points >= 8,
            sigma_px=0 <= self.sigma_px < math.inf,
            corrupted_pairs=0 <= self.corrupted_pairs <= math.comb(max(self.cameras, 0), 2),
            outliers=0 <= self.outliers < 1,
            outlier_range_px=0 < self.outlier_range_px < math.inf,
            other_focal=0.2 <= self.other_focal <= 5,
            size=min(self.width, self.height) >= 16,
            focal_px=0 < self.focal_px[0] <= self.focal_px[1] < math.inf,
            aspect=0 < self.aspect[0] <= self.aspect[1] < math.inf,
            center_offset=0 <= self.center_offset <= 0.4,
            max_rotation_deg=0 < self.max_rotation_deg <= 90,
            max_shift=0 < self.max_shift <= 2,
        )


@dataclass(frozen=True, slots=True, eq=False)
class TwoViews:
    """Matches of two views and their ground truth."""

    x1: FloatArray
    x2: FloatArray
    """(N, 2) pixels; row k of x2 matches row k of x1."""
    is_inlier: BoolArray
    """(N,): False where x2 was displaced. An outlier may still lie near its epipolar line by chance."""
    F: FloatArray
    """(3, 3) from the cameras; x2' F x1 = 0 without noise, rank 2, Frobenius norm 1."""
    K1: FloatArray
    K2: FloatArray
    R: FloatArray
    t: FloatArray
    """(3, 3) rotation and (3,) translation of cam2_from_cam1."""
    exact_x1: FloatArray
    exact_x2: FloatArray
    """(N, 2) pixels of both photos before noise and outliers."""

    @property
    def K(self) -> FloatArray:
        """(3, 3) camera matrix of view 1, and of view 2 unless their focal lengths differ."""
        return self.K1


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Tracks of points that every camera sees, and their ground truth."""

    pairs: Mapping[tuple[int, int], TwoViews]
    """Matches per pair of cameras (i, j), i < j; the noise of a point is the same in all pairs."""
    corrupted: tuple[tuple[int, int], ...]
    K: FloatArray
    """(C, 3, 3) camera matrix per camera; all equal unless the last one has another focal length."""
    R: FloatArray
    t: FloatArray
    """(C, 3, 3) rotations and (C, 3) translations of cam_from_world."""
    X: FloatArray
    """(N, 3) points in the world."""
    x: FloatArray
    """(C, N, 2) pixels with noise, without outliers."""
    size: tuple[int, int]

    @property
    def F(self) -> FloatArray:
        """(P, 3, 3) true fundamental matrices in the order of `pairs`."""
        return np.stack([pair.F for pair in self.pairs.values()])


def make_pair(options: PairOptions, seed: int, max_setups: int = MAX_SETUPS) -> TwoViews:
    """Return a random convergent camera pair and its matches, as in thesis section 4.8.

    Both images get Gaussian noise; then a uniform value is added in image 2 to the outliers, which are random rows.
    """
    rng = np.random.default_rng([seed, 408])
    K = camera_matrix(options.focal_px, options.focal_px, options.width / 2, options.height / 2)
    size = (options.width, options.height)
    for _ in range(max_setups):
        R = random_rotation(rng, options.max_rotation_deg)
        # the minimum baseline keeps the motion away from a pure rotation
        center = _random_direction(rng) * options.max_baseline * rng.uniform(0.1, 1.0)
        poses = (np.stack([np.eye(3), R]), np.stack([np.zeros(3), -R @ center]))
        Ks = np.stack([K, K])
        if _is_convergent(Ks, poses, size, rng):
            exact = _project(Ks, poses, _visible_points(Ks, poses, size, options.points, rng))
            noisy = exact + rng.normal(scale=options.sigma_px, size=exact.shape)
            outliers = (options.outliers, options.outlier_range_px)
            return _two_views((0, 1), (exact, noisy), (Ks, *poses), outliers, rng)
    raise ConfigError("no random camera pair sees the same points", hint="lower max_rotation_deg or max_baseline")


def make_tracks(options: TrackOptions, seed: int, max_setups: int = MAX_SETUPS) -> Tracks:
    """Draw cameras of one random K around a common pose, and points that all of them see, as in thesis 5.5.3."""
    rng = np.random.default_rng([seed, 553])
    size = (options.width, options.height)
    for _ in range(max_setups):
        Ks = _random_intrinsics(options, rng)
        R = np.stack([random_rotation(rng, options.max_rotation_deg) for _ in range(options.cameras)])
        centers = np.stack([_random_direction(rng) * options.max_shift * rng.uniform() for _ in range(options.cameras)])
        poses = (R, -np.einsum("cij,cj->ci", R, centers))
        if _is_convergent(Ks, poses, size, rng):
            return _tracks(options, Ks, poses, rng)
    raise ConfigError("no random cameras see the same points", hint="lower max_rotation_deg or max_shift")


def random_rotation(rng: np.random.Generator, max_angle_deg: float) -> FloatArray:
    """Return (3, 3) rotation about a uniformly random axis by a uniformly random angle."""
    return axis_rotation(_random_direction(rng), rng.uniform(0.0, max_angle_deg))


def _tracks(options: TrackOptions, Ks: FloatArray, poses: Poses, rng: np.random.Generator) -> Tracks:
    size = (options.width, options.height)
    X = _visible_points(Ks, poses, size, options.points, rng)
    exact = _project(Ks, poses, X)
    noisy = exact + rng.normal(scale=options.sigma_px, size=exact.shape)
    pairs = list(combinations(range(options.cameras), 2))
    chosen = rng.choice(len(pairs), options.corrupted_pairs, replace=False)
    corrupted = tuple(pairs[k] for k in sorted(chosen))
    views = {}
    for pair in pairs:
        outliers = (options.outliers if pair in corrupted else 0.0, options.outlier_range_px)
        views[pair] = _two_views(pair, (exact, noisy), (Ks, *poses), outliers, rng)
    return Tracks(views, corrupted, Ks, poses[0], poses[1], X, noisy, size)


def _random_intrinsics(options: TrackOptions, rng: np.random.Generator) -> FloatArray:
    fx = rng.uniform(*options.focal_px)
    fy = fx * rng.uniform(*options.aspect)
    shift = rng.uniform(-options.center_offset, options.center_offset, 2)
    K = camera_matrix(fx, fy, options.width * (0.5 + shift[0]), options.height * (0.5 + shift[1]))
    Ks = np.repeat(K[None], options.cameras, axis=0)
    Ks[-1, :2, :2] *= options.other_focal
    return Ks


def _two_views(
    pair: tuple[int, int], points: tuple[FloatArray, FloatArray], cameras: tuple[FloatArray, FloatArray, FloatArray],
    outliers: tuple[float, float], rng: np.random.Generator,
) -> TwoViews:  # fmt: skip
    i, j = pair
    exact, noisy = points
    Ks, Rs, ts = cameras
    R = Rs[j] @ Rs[i].T
    t = ts[j] - R @ ts[i]
    x2, is_inlier = _with_outliers(noisy[j], *outliers, rng)
    F = fundamental_from_pose(Ks[i], Ks[j], R, t)
    return TwoViews(noisy[i].copy(), x2, is_inlier, F, Ks[i], Ks[j], R, t, exact[i], exact[j])


def _with_outliers(
    x: FloatArray, share: float, reach_px: float, rng: np.random.Generator
) -> tuple[FloatArray, BoolArray]:
    is_inlier = np.ones(len(x), dtype=np.bool_)
    is_inlier[rng.permutation(len(x))[: round(share * len(x))]] = False
    displaced = x.copy()
    displaced[~is_inlier] += rng.uniform(-reach_px, reach_px, (np.count_nonzero(~is_inlier), 2))
    return displaced, is_inlier


def _is_convergent(Ks: FloatArray, poses: Poses, size: tuple[int, int], rng: np.random.Generator) -> bool:
    drawn = next(_candidates(Ks, poses, size, rng))
    return bool(np.mean(_is_in_all_views(Ks, poses, size, drawn)) >= 0.3)  # of the points of the first camera


def _visible_points(
    Ks: FloatArray, poses: Poses, size: tuple[int, int], count: int, rng: np.random.Generator
) -> FloatArray:
    visible: list[FloatArray] = []
    for drawn in _candidates(Ks, poses, size, rng):
        visible.append(drawn[_is_in_all_views(Ks, poses, size, drawn)])
        if sum(map(len, visible)) >= count:
            break
    return np.concatenate(visible)[:count]


def _candidates(Ks: FloatArray, poses: Poses, size: tuple[int, int], rng: np.random.Generator) -> Iterator[FloatArray]:
    # uniform in image 1 and in depth; callers keep the points that are visible in the other images
    while True:
        x = rng.uniform(size=(256, 2)) * size
        depth = rng.uniform(*DEPTHS, (256, 1))
        rays = np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(Ks[0]).T
        yield (rays * depth - poses[1][0]) @ poses[0][0]


def _is_in_all_views(Ks: FloatArray, poses: Poses, size: tuple[int, int], X: FloatArray) -> BoolArray:
    camera = np.einsum("cij,nj->cni", poses[0], X) + poses[1][:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        x = _project(Ks, poses, X)
    # a point next to a camera would be seen only by chance and dominate the noise
    inside = (camera[..., 2] > 0.1) & np.all((x >= 0) & (x <= size), axis=-1)
    return np.asarray(np.all(inside, axis=0))


def _project(Ks: FloatArray, poses: Poses, X: FloatArray) -> FloatArray:
    camera = np.einsum("cij,nj->cni", poses[0], X) + poses[1][:, None]
    h = np.einsum("cij,cnj->cni", Ks, camera)
    return np.asarray(h[..., :2] / h[..., 2:])


def _random_direction(rng: np.random.Generator) -> FloatArray:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))
