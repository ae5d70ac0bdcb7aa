"""Matches that do not determine a fundamental matrix: planes, watermarks, too few points."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sfm_app.fundamental.a_contrario import MOST_FALSE_ALARMS, accidental_share, false_alarms
from sfm_app.fundamental.pretests import PreTest
from sfm_app.fundamental.refits import factorize
from sfm_app.fundamental.samples import RandomState, uniform
from sfm_app.fundamental.scores import FIRST, Loss, penalty, squared_distances
from sfm_app.fundamental.solvers import decompose_symmetric
from sfm_app.jit import kernel
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, Rejected
from sfm_app.types.arrays import BoolArray, FloatArray

# The plane that holds most of a model's inliers, and the matches off it.
#
# Hartley and Zisserman (2004), Result 13.6, as a regression whose weights are ours.
#
# Where one homography H explains the matches, every F = [e]x H does, for any epipole e: the estimator then picks
# the e that gets the most inliers by chance. The evidence for an epipole is matches off the plane.

OFF_PLANE = 2.0
"""Transfer distance in thresholds beyond which a match is off the plane. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
_PLANE_SAMPLES, _PLANE_SAMPLE_SIZE = 64, 3
"""Samples of three matches: a plane that holds half of them is missed twice in ten thousand times, (7/8)^64. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
_LEAST_AREA = 1e-3
"""Twice the area of the triangle of a sample, in squares of the points' spread: thinner ones determine no plane. Chosen
by hand; halved and doubled by `benchmarks.sensitivity`."""
_MOST_SCORED_ON_PLANE = 300
"""Matches that a sampled plane is scored on. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
_LEAST_SUPPORT = 1e-12
"""Smallest over largest eigenvalue of the regression for a plane. Double precision leaves 1e-16 of the largest. Chosen
by hand; halved and doubled by `benchmarks.sensitivity`."""


@kernel
def dominant_homography(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Return the homography of the plane that holds the most matches, among those compatible with F.

    Such homographies are H = A - e2 v' with A = [e2]x F and v' x1 = b for every match on the plane, where
    b = (x2 x A x1)'(x2 x e2) / |x2 x e2|^2 (Hartley and Zisserman, Result 13.6): a linear regression with three
    parameters. Its noise is proportional to 1 / |x2 x e2|, so each match has the weight |x2 x e2|^2.

    Args:
        points: (N, 4) inliers of F in random order, N >= 3.
        F: (3, 3).
        threshold: largest distance of a match to the plane.

    Returns:
        (3, 3), x2 ~ H x1.
    """
    U, _, _ = factorize(F)
    e2, A = np.empty(3), np.empty((3, 3))
    for i in range(3):
        e2[i] = U[i, 2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for n in range(3):
            A[i, n] = e2[j] * F[k, n] - e2[k] * F[j, n]
    b, weights = _plane_equations(points, A, e2)
    best = _sample_plane(points, b, A, e2, 2.0 * threshold * threshold)
    H = _homography(A, e2, best)
    squared, on_plane = _squared_transfer_distances(points, H), 0
    for i in range(points.shape[0]):
        if squared[i] <= threshold * threshold:
            on_plane += 1
        else:
            weights[i] = 0.0
    if on_plane >= _PLANE_SAMPLE_SIZE and _fit_plane(points, b, weights, best):
        H = _homography(A, e2, best)
    return H


@kernel
def _homography(A: FloatArray, e2: FloatArray, v: FloatArray) -> FloatArray:
    """Return A - e2 v'."""
    H = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            H[i, j] = A[i, j] - e2[i] * v[j]
    return H


@kernel
def _plane_equations(points: FloatArray, A: FloatArray, e2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return b of every match, and |x2 x e2|^2, the weight of its equation v' x1 = b."""
    b, weights = np.empty(points.shape[0]), np.empty(points.shape[0])
    for i in range(points.shape[0]):
        x1, y1, x2, y2 = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
        px, py = A[0, 0] * x1 + A[0, 1] * y1 + A[0, 2], A[1, 0] * x1 + A[1, 1] * y1 + A[1, 2]
        pz = A[2, 0] * x1 + A[2, 1] * y1 + A[2, 2]
        tx, ty, tz = y2 * e2[2] - e2[1], e2[0] - x2 * e2[2], x2 * e2[1] - y2 * e2[0]
        weights[i] = tx * tx + ty * ty + tz * tz
        along = (y2 * pz - py) * tx + (px - x2 * pz) * ty + (x2 * py - y2 * px) * tz
        b[i] = along / max(weights[i], 1e-300)
    return b, weights


@kernel
def _fit_plane(points: FloatArray, b: FloatArray, weights: FloatArray, plane: FloatArray) -> bool:
    """Fit v' x1 = b by weighted least squares and write v to `plane` (3,).

    Returns False and writes nothing for points on one line.
    """
    gram, values, vectors = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    right, row = np.zeros(3), np.ones(3)
    for i in range(points.shape[0]):
        row[0], row[1] = points[i, 0], points[i, 1]
        for j in range(3):
            right[j] += weights[i] * row[j] * b[i]
            for k in range(3):
                gram[j, k] += weights[i] * row[j] * row[k]
    decompose_symmetric(gram, values, vectors)
    if not values[0] > _LEAST_SUPPORT * values[2]:
        return False
    for j in range(3):
        plane[j] = 0.0
    for n in range(3):
        along = 0.0
        for j in range(3):
            along += vectors[j, n] * right[j]
        for j in range(3):
            plane[j] += along / values[n] * vectors[j, n]
    return True


@kernel
def _sample_plane(points: FloatArray, b: FloatArray, A: FloatArray, e2: FloatArray, limit: float) -> FloatArray:
    """Return the v through three sampled matches whose H maps most of the first matches to within sqrt(limit)."""
    count, most, state = min(points.shape[0], _MOST_SCORED_ON_PLANE), -1, np.empty(1, dtype=np.uint64)
    best, corner, v = np.zeros(3), np.empty(3, dtype=np.int64), np.empty(3)
    state[0] = count
    mapped = np.empty((3, count))
    for i in range(count):
        for r in range(3):
            mapped[r, i] = A[r, 0] * points[i, 0] + A[r, 1] * points[i, 1] + A[r, 2]
    for _ in range(_PLANE_SAMPLES):
        for k in range(3):
            corner[k] = int(uniform(state) * count)
        p, q, r = corner[0], corner[1], corner[2]
        x, y = points[q, 0] - points[p, 0], points[q, 1] - points[p, 1]
        z, w = points[r, 0] - points[p, 0], points[r, 1] - points[p, 1]
        area = x * w - z * y
        if not abs(area) > _LEAST_AREA:
            continue
        v[0] = ((b[q] - b[p]) * w - (b[r] - b[p]) * y) / area
        v[1] = (x * (b[r] - b[p]) - z * (b[q] - b[p])) / area
        v[2] = b[p] - v[0] * points[p, 0] - v[1] * points[p, 1]
        on_plane = 0
        for i in range(count):
            along = v[0] * points[i, 0] + v[1] * points[i, 1] + v[2]
            depth = mapped[2, i] - e2[2] * along
            dx = mapped[0, i] - e2[0] * along - points[i, 2] * depth
            dy = mapped[1, i] - e2[1] * along - points[i, 3] * depth
            on_plane += dx * dx + dy * dy <= limit * depth * depth
        if on_plane > most:
            most = on_plane
            for k in range(3):
                best[k] = v[k]
    return best


def transfer_distance(H: FloatArray, points: FloatArray) -> FloatArray:
    """Return (N,) |x2 - H x1| / sqrt(2): about the distance in 4D of (x1, x2) to the nearest match that fits H exactly.

    Args:
        H: (3, 3) homography, view 2 from view 1.
        points: (N, 4) matches, in the same frame.
    """
    return np.sqrt(_squared_transfer_distances(points, H))


@kernel
def _squared_transfer_distances(points: FloatArray, H: FloatArray) -> FloatArray:
    squared = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        depth = H[2, 0] * x + H[2, 1] * y + H[2, 2]
        dx = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / depth - points[i, 2]
        dy = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / depth - points[i, 3]
        squared[i] = (dx * dx + dy * dy) / 2.0 if depth != 0.0 else np.inf
    return squared


# Matches that do not determine F: all on one line of a photo, on one plane, or from a camera that did not move.
#
# Ours, with Hartley and Zisserman (2004), 11.9, on the parameters that a line or a plane leaves free, and Moisan
# and Stival (2004) on chance.
#
# Matches on a line of one view leave two parameters of F free, on a line of both views four. As many other matches
# fix them, even mismatches: the evidence is more matches off the line than expected by chance. In the same way the
# evidence for an epipole is matches off the dominant plane (see `dominant_plane`).

_LINE_SAMPLE, _PARALLAX_SAMPLE = 4, 2
"""Matches that fix the parameters of F that a line, or a plane, leaves free. Counted: parameters of F
(docs/algorithms.md, All estimators)."""
_OFF_LINE = 2.0
"""Distance in thresholds beyond which a match is off the line, as for planes `dominant_plane.OFF_PLANE`. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
_LINES, _MOST_SCORED = 16, 300
"""Sampled lines, and the inliers that each is scored on. A relevant line holds most inliers, so few samples find it:
one of 16 pairs lies on a line that holds half of them 99 times in 100. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
_EXTENT_QUANTILES = (0.01, 0.99)
"""Quantiles that bound the points of a view, without a few gross outliers. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
_FOCALS = np.geomspace(0.4, 6.0, 60)
"""Focal lengths that are tried for a rotation, in sides of the box around the points. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
_LEAST_PARALLAX_SHARE = 0.05
"""Share of the inliers off the plane below which a rotation counts as one. Mismatches on rows of bricks share a
vanishing point: they agree with an epipole there far more often than by chance. On the real photo sets no pair has such
a homography and less than 40 % off it (docs/algorithms.md, All estimators)."""
_ROTATION_TOLERANCE = 0.05
"""Largest relative stretch of a homography that counts as a rotation, for some focal length; a rotation has none.
Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


def find_degeneracy(
    points: FloatArray, F: FloatArray, inliers: BoolArray, wrong: FloatArray, threshold: float, centers: FloatArray
) -> str:
    """Return the kind of degeneracy that leaves F undetermined.

    Args:
        points: (N, 4) matches in random order.
        F: (3, 3) the model.
        inliers: (N,) mask, at least 3 of them True.
        wrong: (M,) squared distances of mismatches to F, from `a_contrario.squared_mismatch_distances`.
        threshold: largest distance of an inlier.
        centers: (4,) the origin of `points` in a frame that both views share, in the same units.

    Returns:
        "collinear" where all matches lie on one line of a photo or at one point (except for a few that may be chance),
        "rotation" where the camera only rotated, "planar" where all matches lie on one plane or too close to one, ""
        where F is determined.
    """
    chance = accidental_share(wrong, threshold)
    for view in range(2):
        off_line = off_line_mask(points, inliers, view, _OFF_LINE * threshold)
        if _can_be_accident(off_line, inliers, _LINE_SAMPLE, chance):
            return "collinear"
    H = dominant_homography(np.asfortranarray(points[inliers]), F, threshold)
    off_plane = transfer_distance(H, points) > OFF_PLANE * threshold
    planar = _can_be_accident(off_plane, inliers, _PARALLAX_SAMPLE, chance)
    parallax = np.count_nonzero(off_plane & inliers) / np.count_nonzero(inliers)
    if (planar or parallax < _LEAST_PARALLAX_SHARE) and is_rotation(H, points, centers):
        return "rotation"
    return "planar" if planar else ""


def _can_be_accident(off: BoolArray, inliers: BoolArray, sample_size: int, chance: float) -> bool:
    """Return whether the inliers among the matches `off` a line or plane could all be mismatches."""
    agreeing = int(np.count_nonzero(off & inliers))
    return false_alarms(int(np.count_nonzero(off)), agreeing, sample_size, chance) > MOST_FALSE_ALARMS


def off_line_mask(points: FloatArray, inliers: BoolArray, view: int, width: float) -> BoolArray:
    """Return which matches lie further than `width` from the line that holds the most inliers of a view.

    Args:
        points: (N, 4) matches in random order.
        inliers: (N,) mask, at least one of them True.
        view: 0 or 1.
        width: in the units of `points`.

    Returns:
        (N,) mask.
    """
    x, y = points[:, 2 * view], points[:, 2 * view + 1]
    a, b, c = _dominant_line(x[inliers], y[inliers], width)
    return np.asarray(np.abs(a * x + b * y + c) > width)


@kernel
def _dominant_line(x: FloatArray, y: FloatArray, width: float) -> tuple[float, float, float]:
    """Return the line a x + b y + c = 0, a^2 + b^2 = 1, through two sampled points, near most of the first points."""
    count, most, best, state = x.shape[0], -1, (1.0, 0.0, 0.0), np.empty(1, dtype=np.uint64)
    state[0] = count
    for _ in range(_LINES):
        i, j = int(uniform(state) * count), int(uniform(state) * count)
        a, b = y[i] - y[j], x[j] - x[i]
        norm = np.sqrt(a * a + b * b)
        a, b = (a / norm, b / norm) if norm > 0.0 else (1.0, 0.0)  # for two equal points any line will do
        c, on_line = -(a * x[i] + b * y[i]), 0
        for n in range(min(count, _MOST_SCORED)):
            on_line += abs(a * x[n] + b * y[n] + c) <= width
        if on_line > most:
            most, best = on_line, (a, b, c)
    return best


def is_rotation(H: FloatArray, points: FloatArray, centers: FloatArray) -> bool:
    """Return whether H = K R K^-1 for one focal length, with the center in the middle of the points of both views.

    Args:
        H: (3, 3) homography, view 2 from view 1, in the frame of the points.
        points: (N, 4) matches.
        centers: (4,) the origin of `points` in a frame that both views share, in the same units.
    """
    placed = points + centers
    low, high = np.quantile(np.vstack([placed[:, :2], placed[:, 2:]]), _EXTENT_QUANTILES, axis=0)
    middle, side = (low + high) / 2, float((high - low).max())
    to1, to2 = _translation(middle - centers[:2]), _translation(centers[2:] - middle)
    for focal in _FOCALS * side:
        K = np.diag([focal, focal, 1.0])
        stretch = np.linalg.svd(np.linalg.inv(K) @ to2 @ H @ to1 @ K, compute_uv=False)
        if stretch[0] <= (1 + _ROTATION_TOLERANCE) * stretch[2]:
            return True
    return False


def _translation(by: FloatArray) -> FloatArray:
    return np.array([[1, 0, by[0]], [0, 1, by[1]], [0, 0, 1]], dtype=np.float64)


# Plane and parallax: the right epipole for a model found on a dominant plane (after Chum, Werner and Matas 2005).
#
# Samples from a scene with one large plane mostly lie on it; their F has the right homography H of the plane, but a
# wrong epipole. With H given, two matches off the plane are a minimal sample: the lines from H x1 to x2 meet in the
# epipole.

_PARALLAX_SAMPLES = 100
"""Samples of two matches off the plane. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
_LEAST_INLIERS = 8
"""Fewer do not determine the dominant plane. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
_MOST_INLIERS = 300
"""Largest number of inliers that the plane is fitted to. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""


def recover_epipole(
    points: FloatArray, F: FloatArray, threshold: float, loss: Loss, pretest: PreTest, state: RandomState
) -> FloatArray | None:
    """Estimate the best model with the dominant plane of F's inliers; None without a plane and two matches off it.

    Args:
        points, F: (N, 4) in random order, and (3, 3).
        threshold: largest distance of an inlier.
        loss: the penalty.
        pretest: the test that a model has to pass, without a random start.
        state: random generator.
    """
    inliers = squared_distances(points, np.ascontiguousarray(F).reshape(9)) <= threshold * threshold
    if np.count_nonzero(inliers) < _LEAST_INLIERS:
        return None
    chosen = np.asfortranarray(points[np.flatnonzero(inliers)[:_MOST_INLIERS]])
    H = dominant_homography(chosen, F, threshold)
    off_plane = np.flatnonzero(transfer_distance(H, points) > OFF_PLANE * threshold)
    if len(off_plane) < 2:
        return None
    best = np.empty(9)
    found = _search_epipole(points, H, off_plane, loss, pretest, state, best)
    return best.reshape(3, 3) if np.isfinite(found) else None


@kernel
def _search_epipole(
    points: FloatArray, H: FloatArray, off_plane: NDArray[np.int64], loss: Loss, pretest: PreTest, state: RandomState,
    best: FloatArray,
) -> float:  # fmt: skip
    lowest, line, f = np.inf, np.empty((2, 3)), np.empty(9)
    for _ in range(_PARALLAX_SAMPLES):
        for k in range(2):
            i = off_plane[int(uniform(state) * off_plane.shape[0])]
            hx = H[0, 0] * points[i, 0] + H[0, 1] * points[i, 1] + H[0, 2]
            hy = H[1, 0] * points[i, 0] + H[1, 1] * points[i, 1] + H[1, 2]
            hz = H[2, 0] * points[i, 0] + H[2, 1] * points[i, 1] + H[2, 2]
            line[k, 0] = hy - hz * points[i, 3]
            line[k, 1] = hz * points[i, 2] - hx
            line[k, 2] = hx * points[i, 3] - hy * points[i, 2]
        ex = line[0, 1] * line[1, 2] - line[0, 2] * line[1, 1]
        ey = line[0, 2] * line[1, 0] - line[0, 0] * line[1, 2]
        ez = line[0, 0] * line[1, 1] - line[0, 1] * line[1, 0]
        for c in range(3):
            f[c] = ey * H[2, c] - ez * H[1, c]
            f[3 + c] = ez * H[0, c] - ex * H[2, c]
            f[6 + c] = ex * H[1, c] - ey * H[0, c]
        squared = 0.0
        for c in range(9):
            squared += f[c] * f[c]
        if not squared > 0.0:
            continue
        for c in range(9):
            f[c] /= np.sqrt(squared)
        score = penalty(points, FIRST, f, loss, lowest, pretest)
        if score < lowest:
            lowest = score
            for c in range(9):
                best[c] = f[c]
    return lowest


# Matches that stay in place while the scene moves: logos, time stamps, dust, or the same photo twice.
#
# Ours; the name is COLMAP's.
#
# A logo agrees with F = [t]x for any t, so that enough of its matches make the camera appear not to rotate. A scene
# may also stay in place in the image, such as an object that the photographer kept in the middle. A logo differs by
# its peak: displacements of a scene vary smoothly with depth and position, and are 0 no more often than any value
# near 0.

Fit = Callable[[FloatArray, FloatArray, EpipolarSettings, int], EpipolarFit | Rejected]

SAME_PHOTO = "the same photo twice, or nearly"
ONLY_A_LOGO = "nothing in common but a logo or time stamp"

PEAK, STATIONARY, RING = 1.0, 2.0, 4.0
"""Largest displacements at the peak, of stationary matches, and of the ring around the peak, in units of keypoint
noise. Checked on the real photo sets, where they affect one pair of 456 (docs/algorithms.md, All estimators)."""
LEAST_PEAK = 8
"""Least number of matches at the peak; fewer are left to the estimator. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
MOST_LOST = 0.2
"""Share of the stationary matches, or of the others, that may be removed from the scene with a logo.
docs/algorithms.md, All estimators. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
CELLS, WIDE_SHARE = 8, 0.25
"""Cells of the photo along each side, and the share of the cells with keypoints that a logo does not exceed. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
EXPLAINED_SHARE = 0.9
"""Share of the stationary matches that a motion without rotation explains. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""


def find_stationary(x1: FloatArray, x2: FloatArray, unit_px: float = 1.0) -> BoolArray:
    """Find the matches that stay in place although the others move, or because nothing moves at all.

    The displacements of a scene are spread along a curve or over an area around 0: between one and four units there are
    at least three times as many as below one. Matches count as stationary where the peak holds no fewer than that
    ring, and where few matches of the scene are lost: video frames in which all move by a few pixels keep theirs.

    Args:
        x1: (N, 2) pixels.
        x2: (N, 2) pixels in a photo of the same size.
        unit_px: generous noise of the keypoints; more than 1 where they were found in a smaller image.

    Returns:
        (N,) mask; all False where there is no such peak.
    """
    squared = np.square(x2 - x1).sum(axis=1) / unit_px**2
    peak, held, reached = (int(np.count_nonzero(squared <= steps**2)) for steps in (PEAK, STATIONARY, RING))
    ring = reached - peak
    # of a scene on a line through 0, each unit of displacement holds a third of the ring
    lost = ring * STATIONARY / (RING - PEAK)
    is_peak = peak >= max(LEAST_PEAK, ring) and lost <= MOST_LOST * max(held, len(x1) - held)
    return squared <= STATIONARY**2 if is_peak else np.zeros(len(x1), bool)


def is_widespread(points: FloatArray, keypoints: FloatArray, size: tuple[int, int]) -> bool:
    """Return whether points are spread over a large part of a photo.

    Args:
        points: (N, 2) pixels.
        keypoints: (M, 2) pixels of all keypoints of the photo.
        size: (width, height) of the photo in pixels.
    """
    return len(_occupied_cells(points, size)) > WIDE_SHARE * len(_occupied_cells(keypoints, size))


def fit_moving(
    fit: Fit, points: tuple[FloatArray, FloatArray], stationary: BoolArray, wide: bool, options: EpipolarSettings,
    seed: int,
) -> EpipolarFit | Rejected:  # fmt: skip
    """Estimate the epipolar geometry of the moving matches; the stationary ones are no inliers and have prior 0.

    Where the camera moved without rotation, distant objects stay in place, too: stationary matches all over the photo
    that agree with the geometry of the others belong to the scene, and all matches are fitted together.

    Args:
        fit: the estimator.
        points: x1, x2, each (N, 2) pixels.
        stationary: (N,) mask from `find_stationary`.
        wide: whether these lie all over the photo, see `watermark.is_widespread`.
        options: settings of the estimator.
        seed: seed of the estimator.

    Returns:
        A fit whose inliers and priors are (N,); or, where the moving matches have no fit, the kind of stationary ones.
    """
    x1, x2 = points
    found = fit(x1[~stationary], x2[~stationary], options, seed)
    if not isinstance(found, EpipolarFit):
        return Rejected(SAME_PHOTO if wide else ONLY_A_LOGO)
    if wide and not found.degeneracy:
        still = np.asfortranarray(np.hstack([x1[stationary], x2[stationary]]))
        agreeing = squared_distances(still, np.ascontiguousarray(found.F).reshape(9)) <= options.max_error_px**2
        if agreeing.mean() >= EXPLAINED_SHARE:
            return fit(x1, x2, options, seed)
    inliers, priors = np.zeros(len(x1), bool), np.zeros(len(x1))
    inliers[~stationary], priors[~stationary] = found.inliers, found.priors
    return EpipolarFit(found.F, inliers, priors, found.trials, found.rms_px, found.degeneracy)


def one_per_cell(points: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Return (C, 2) one point of each cell of a photo that has any; `is_widespread` needs no more of all keypoints.

    Args:
        points: (N, 2) pixels.
        size: (width, height) of the photo in pixels.
    """
    return points[np.unique(_cells(points, size), return_index=True)[1]]


def _occupied_cells(points: FloatArray, size: tuple[int, int]) -> NDArray[np.int64]:
    return np.unique(_cells(points, size))


def _cells(points: FloatArray, size: tuple[int, int]) -> NDArray[np.int64]:
    """Return (N,) the number of the cell of each point."""
    columns, rows = (points / size * CELLS).astype(np.int64).clip(0, CELLS - 1).T
    return np.asarray(CELLS * rows + columns)
