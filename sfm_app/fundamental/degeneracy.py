"""Matches that do not determine F: planes, lines, rotations (Hartley and Zisserman 2004, 11.9), watermarks (ours)."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sfm_app.fundamental.a_contrario import MOST_FALSE_ALARMS, accidental_share, false_alarms
from sfm_app.fundamental.pretests import BailOut, PreTest
from sfm_app.fundamental.refits import factorize
from sfm_app.fundamental.samples import RandomState, uniform
from sfm_app.fundamental.scores import FIRST, Loss, penalty, squared_distances
from sfm_app.fundamental.solvers import decompose_symmetric
from sfm_app.jit import kernel
from sfm_app.settings import EpipolarSettings
from sfm_app.types import EpipolarFit, EpipolarGeometry, Rejected
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray


class DEGENERACY:
    """When matches count as degenerate."""

    off: float = 2.0
    """Distance in thresholds beyond which a match is off a plane, a line or a rotation. Chosen by hand."""
    clear_share: float = 0.95
    """Share of the inliers that a plane or a rotation must explain to be one. Chosen by hand."""
    line_sample: int = 4
    """Matches that fix the parameters of F that a line leaves free. Counted (docs/algorithms/lev-ransac.md)."""
    parallax_sample: int = 2
    """Matches that fix the parameters of F that a plane leaves free. Counted (docs/algorithms/lev-ransac.md)."""
    parallax_trials: int = 4000
    """Most samples of matches off a plane: two of a share of 5 % are right ten times. Chosen by hand."""
    parallax_confidence: float = 0.9999
    """Probability of a right sample that ends them. Chosen by hand."""
    extent_quantiles: tuple[float, float] = (0.01, 0.99)
    """Quantiles that bound the points of a view, without a few gross outliers. Chosen by hand."""
    focals: tuple[float, float, int] = (0.4, 6.0, 60)
    """Focal lengths that a rotation may have, in sides of the box around the points: range, number. Chosen by hand."""
    least_parallax_share: float = 0.05
    """Share of the inliers off the plane below which a rotation counts as one (docs/algorithms/lev-ransac.md).
    Mismatches on rows of bricks agree with a vanishing point as epipole far more often than by chance."""
    rotation_tolerance: float = 0.05
    """Largest relative stretch of a rotation's homography, for some focal length. Chosen by hand."""


# Dominant plane: the plane with most of a model's inliers, and the matches off it. Hartley and Zisserman (2004),
# Result 13.6, as a regression whose weights are ours. Where one homography H explains the matches, every F = [e]x H
# does, for any epipole e. Only matches off the plane are evidence for an epipole.

_MOST_SCORED = 300
"""Inliers that sampled planes and lines are scored on, and a dominant plane is fitted to. Chosen by hand."""


@kernel
def dominant_homography(points: FloatArray, F: FloatArray, threshold: float) -> FloatArray:
    """Return H (3, 3), x2 ~ H x1, of the plane that holds the most of F's inliers, N >= 3, compatible with F.

    Such homographies are H = A - e2 v' with A = [e2]x F and v' x1 = b for every match on the plane, where b = (x2 x A
    x1)'(x2 x e2) / |x2 x e2|^2 (Hartley and Zisserman, Result 13.6): a linear regression with three parameters. Its
    noise is proportional to 1 / |x2 x e2|, so each match has the weight |x2 x e2|^2.
    """
    U, _, _ = factorize(F)
    e2, A = U[:, 2].copy(), np.empty((3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for n in range(3):
            A[i, n] = e2[j] * F[k, n] - e2[k] * F[j, n]
    b, weights = _plane_equations(points, A, e2)
    best = _sample_plane(points, b, A, e2, 2.0 * threshold * threshold)
    H = A - np.outer(e2, best)
    squared, on_plane = _squared_transfer_distances(points, H), 0
    for i in range(points.shape[0]):
        if squared[i] <= threshold * threshold:
            on_plane += 1
        else:
            weights[i] = 0.0
    if on_plane >= 3 and _fit_plane(points, b, weights, best):
        H = A - np.outer(e2, best)
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
        moment = (y2 * pz - py) * tx + (px - x2 * pz) * ty + (x2 * py - y2 * px) * tz
        b[i] = moment / max(weights[i], 1e-300)
    return b, weights


@kernel
def _fit_plane(points: FloatArray, b: FloatArray, weights: FloatArray, plane: FloatArray) -> bool:
    """Fit v' x1 = b by weighted least squares and write v to `plane` (3,); return False for points on one line."""
    gram, values, vectors = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    right, row = np.zeros(3), np.ones(3)
    for i in range(points.shape[0]):
        row[0], row[1] = points[i, 0], points[i, 1]
        for j in range(3):
            right[j] += weights[i] * row[j] * b[i]
            for k in range(3):
                gram[j, k] += weights[i] * row[j] * row[k]
    decompose_symmetric(gram, values, vectors)
    if not values[0] > 1e-12 * values[2]:
        return False
    plane[:] = 0.0
    for n in range(3):
        projection = 0.0
        for j in range(3):
            projection += vectors[j, n] * right[j]
        for j in range(3):
            plane[j] += projection / values[n] * vectors[j, n]
    return True


@kernel
def _sample_plane(points: FloatArray, b: FloatArray, A: FloatArray, e2: FloatArray, limit: float) -> FloatArray:
    """Return the v through three sampled matches whose H maps most of the first matches to within sqrt(limit)."""
    count, most, state = min(points.shape[0], _MOST_SCORED), -1, np.empty(1, dtype=np.uint64)
    best, corner, v = np.zeros(3), np.empty(3, dtype=np.int64), np.empty(3)
    state[0] = count
    mapped = np.empty((3, count))
    for i in range(count):
        for r in range(3):
            mapped[r, i] = A[r, 0] * points[i, 0] + A[r, 1] * points[i, 1] + A[r, 2]
    for _ in range(64):  # misses a plane with half of the matches twice in ten thousand times, (7/8)^64
        for k in range(3):
            corner[k] = int(uniform(state) * count)
        p, q, r = corner[0], corner[1], corner[2]
        x, y = points[q, 0] - points[p, 0], points[q, 1] - points[p, 1]
        z, w = points[r, 0] - points[p, 0], points[r, 1] - points[p, 1]
        area = x * w - z * y
        if not abs(area) > 1e-3:  # thinner triangles determine no plane
            continue
        v[0] = ((b[q] - b[p]) * w - (b[r] - b[p]) * y) / area
        v[1] = (x * (b[r] - b[p]) - z * (b[q] - b[p])) / area
        v[2] = b[p] - v[0] * points[p, 0] - v[1] * points[p, 1]
        on_plane = 0
        for i in range(count):
            shift = v[0] * points[i, 0] + v[1] * points[i, 1] + v[2]
            depth = mapped[2, i] - e2[2] * shift
            dx = mapped[0, i] - e2[0] * shift - points[i, 2] * depth
            dy = mapped[1, i] - e2[1] * shift - points[i, 3] * depth
            on_plane += dx * dx + dy * dy <= limit * depth * depth
        if on_plane > most:
            most = on_plane
            best[:] = v
    return best


def transfer_distance(H: FloatArray, points: FloatArray) -> FloatArray:
    """Return (N,) |x2 - H x1| / sqrt(2), about the distance in 4D of (x1, x2) to the nearest match that fits H."""
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


# Degenerate matches: all on one line of a photo, on one plane, or from a camera that only rotated. Ours, with Hartley
# and Zisserman (2004), 11.9, and Moisan and Stival (2004) on chance. Matches on a line of one view leave two
# parameters of F free, on a line of both views four. As many other matches fix them, even mismatches. The evidence is
# more matches off the line, or off the plane, than expected by chance.


def find_degeneracy(
    points: FloatArray, F: FloatArray, inliers: BoolArray, wrong: FloatArray, threshold: float, centers: FloatArray
) -> str:
    """Return the kind of degeneracy that leaves F undetermined: "" where it is determined.

    "collinear": all matches lie on one line of a photo or at one point, up to a few that may be chance; "rotation": the
    camera only rotated; "planar": all matches lie on one plane or too close to it. At least 3 `inliers`; `wrong` are
    `squared_mismatch_distances`; `centers` (4,) is the origin of `points` in a frame that both views share.
    """
    chance = accidental_share(wrong, threshold)
    for view in range(2):
        off_line = off_line_mask(points, inliers, view, DEGENERACY.off * threshold)
        if _can_be_chance(off_line, inliers, DEGENERACY.line_sample, chance):
            return "collinear"
    H = dominant_homography(np.asfortranarray(points[inliers]), F, threshold)
    off_plane = transfer_distance(H, points) > DEGENERACY.off * threshold
    planar = _can_be_chance(off_plane, inliers, DEGENERACY.parallax_sample, chance)
    parallax = np.count_nonzero(off_plane & inliers) / np.count_nonzero(inliers)
    if (planar or parallax < DEGENERACY.least_parallax_share) and is_rotation(H, points, centers):
        return "rotation"
    return "planar" if planar else ""


def _can_be_chance(off: BoolArray, inliers: BoolArray, sample_size: int, chance: float) -> bool:
    """Return whether the inliers among the matches `off` a line or plane could all be mismatches."""
    agreeing = int(np.count_nonzero(off & inliers))
    return false_alarms(int(np.count_nonzero(off)), agreeing, sample_size, chance) > MOST_FALSE_ALARMS


def off_line_mask(points: FloatArray, inliers: BoolArray, view: int, width: float) -> BoolArray:
    """Return (N,) which matches lie further than `width` from the line with the most inliers (N,) of view 0 or 1."""
    x, y = points[:, 2 * view], points[:, 2 * view + 1]
    a, b, c = _dominant_line(x[inliers], y[inliers], width)
    return np.asarray(np.abs(a * x + b * y + c) > width)


@kernel
def _dominant_line(x: FloatArray, y: FloatArray, width: float) -> tuple[float, float, float]:
    """Return the line a x + b y + c = 0, a^2 + b^2 = 1, through two sampled points, near most of the first points."""
    count, most, best, state = x.shape[0], -1, (1.0, 0.0, 0.0), np.empty(1, dtype=np.uint64)
    state[0] = count
    for _ in range(16):  # misses a line with half of the inliers once in a hundred times
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
    """Return whether H = K R K^-1 for one focal and a middle center; `centers` (4,) as in `find_degeneracy`."""
    shifted = points + centers
    low, high = np.quantile(np.vstack([shifted[:, :2], shifted[:, 2:]]), DEGENERACY.extent_quantiles, axis=0)
    middle, side = (low + high) / 2, float((high - low).max())
    to1, to2 = _translation(middle - centers[:2]), _translation(centers[2:] - middle)
    for focal in np.geomspace(*DEGENERACY.focals) * side:
        K = np.diag([focal, focal, 1.0])
        stretch = np.linalg.svd(np.linalg.inv(K) @ to2 @ H @ to1 @ K, compute_uv=False)
        if stretch[0] <= (1 + DEGENERACY.rotation_tolerance) * stretch[2]:
            return True
    return False


def _translation(t: FloatArray) -> FloatArray:
    return np.array([[1, 0, t[0]], [0, 1, t[1]], [0, 0, 1]], dtype=np.float64)


# Plane and parallax: the right epipole for a model of a dominant plane (after Chum, Werner and Matas 2005). Samples
# from one large plane give its homography H but a wrong epipole. With H given, two matches off the plane are a
# minimal sample: the lines from H x1 to x2 meet in the epipole. Of the matches off a facade, few are right: they need
# many samples, which cost little, as only these matches are scored.


def recover_epipole(
    points: FloatArray, F: FloatArray, threshold: float, loss: Loss, state: RandomState
) -> FloatArray | None:
    """Estimate the best model with the dominant plane of F's inliers; None without a plane and two matches off it.

    `loss` is Geman and McClure's. Its scale decides which matches agree with an epipole: within the threshold, too many
    agree with a wrong one.
    """
    inliers = squared_distances(points, np.ascontiguousarray(F).reshape(9)) <= threshold * threshold
    if np.count_nonzero(inliers) < 8:
        return None
    chosen = np.asfortranarray(points[np.flatnonzero(inliers)[:_MOST_SCORED]])
    H = dominant_homography(chosen, F, threshold)
    off_plane = np.asfortranarray(points[transfer_distance(H, points) > threshold])
    if len(off_plane) < DEGENERACY.parallax_sample:
        return None
    loss = loss._replace(limit=1.0 / loss.precision)
    best, lowest, trials, needed = np.zeros(9), np.full(1, np.inf), 0, DEGENERACY.parallax_trials
    test = BailOut(len(off_plane), DEGENERACY.parallax_sample)
    while trials < needed:
        trials += _draw_epipoles(off_plane, H, loss, test.pretest, needed - trials, state, lowest, best)
        share = float(np.mean(squared_distances(off_plane, best) <= loss.limit))
        test.expect(share)
        needed = math.ceil(min(test.required_trials(share, DEGENERACY.parallax_confidence), needed))
    return best.reshape(3, 3) if np.isfinite(lowest[0]) else None


@kernel
def _draw_epipoles(  # noqa: PLR0913
    points: FloatArray, H: FloatArray, loss: Loss, pretest: PreTest, limit: int, state: RandomState,
    lowest: FloatArray, best: FloatArray,
) -> int:  # fmt: skip
    """Draw pairs of matches off the plane (N, 4) until an epipole e lowers `lowest` (1,); return their number.

    Writes F = [e]x H to `best` (9,).
    """
    line, f = np.empty((2, 3)), np.empty(9)
    for trial in range(1, limit + 1):
        for k in range(2):
            i = int(uniform(state) * points.shape[0])
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
        f /= np.sqrt(squared)
        score = penalty(points, FIRST, f, loss, lowest[0], pretest)
        if score < lowest[0]:
            lowest[0] = score
            best[:] = f
            return trial
    return limit


# Watermarks: logos, time stamps, dust, or the same photo twice. Ours; the name is COLMAP's. A logo agrees with F =
# [t]x for any t, so that enough of its matches hide the rotation. A scene may stay in place, too. A logo differs by
# its peak: displacements of a scene vary smoothly, and are 0 no more often than any value near 0.

Fit = Callable[[FloatArray, FloatArray, EpipolarSettings, int], EpipolarGeometry | Rejected]

SAME_PHOTO = "the same photo twice, or nearly"
ONLY_A_LOGO = "nothing in common but a logo or time stamp"


class WATERMARK:
    """When matches that stay in place are no part of the scene."""

    peak: float = 1.0
    """Largest displacement at the peak, in units of keypoint noise (docs/algorithms/lev-ransac.md)."""
    stationary: float = 2.0
    """Largest displacement of a stationary match, in the same unit (docs/algorithms/lev-ransac.md)."""
    ring: float = 4.0
    """Outer radius of the ring around the peak, in the same unit (docs/algorithms/lev-ransac.md)."""
    least_peak: int = 8
    """Least number of matches at the peak; the estimator copes with fewer. Chosen by hand."""
    most_lost: float = 0.2
    """Largest share of the stationary matches, or of the others, that the scene loses with a logo
    (docs/algorithms/lev-ransac.md). Chosen by hand."""
    cells: int = 8
    """Cells of a photo along each side. Chosen by hand."""
    wide_share: float = 0.25
    """Share of the cells with keypoints that a logo does not exceed. Chosen by hand."""
    explained_share: float = 0.9
    """Share of the stationary matches that a motion without rotation explains. Chosen by hand."""


def find_stationary(x1: FloatArray, x2: FloatArray, unit_px: float = 1.0) -> BoolArray:
    """Find the matches (N,) that stay in place although the others move, or because nothing moves at all.

    The displacements of a scene are spread along a curve or over an area around 0: between one and four units there are
    at least three times as many as below one. Matches are stationary where the peak holds no fewer than that ring, and
    where the scene loses few matches: video frames in which all move by a few pixels keep theirs. `unit_px` is a
    generous noise of the keypoints; more than 1 where they were detected in a smaller image.
    """
    squared = np.square(x2 - x1).sum(axis=1) / unit_px**2
    peak, stationary, within_ring = (
        int(np.count_nonzero(squared <= radius**2)) for radius in (WATERMARK.peak, WATERMARK.stationary, WATERMARK.ring)
    )
    ring = within_ring - peak
    # of a scene on a line through 0, each unit of displacement holds a third of the ring
    lost = ring * WATERMARK.stationary / (WATERMARK.ring - WATERMARK.peak)
    is_peak = peak >= max(WATERMARK.least_peak, ring) and lost <= WATERMARK.most_lost * max(
        stationary, len(x1) - stationary
    )
    return squared <= WATERMARK.stationary**2 if is_peak else np.zeros(len(x1), bool)


def is_widespread(points: FloatArray, keypoints: FloatArray, size: tuple[int, int]) -> bool:
    """Return whether points (N, 2) cover a large part of a photo, compared with all its keypoints (M, 2)."""
    occupied, with_keypoints = (len(np.unique(_cells(some, size))) for some in (points, keypoints))
    return occupied > WATERMARK.wide_share * with_keypoints


def fit_moving(
    fit: Fit, points: tuple[FloatArray, FloatArray], stationary: BoolArray, wide: bool, options: EpipolarSettings,
    seed: int,
) -> EpipolarGeometry | Rejected:  # fmt: skip
    """Estimate the epipolar geometry of the moving matches; the stationary ones are no inliers and have prior 0.

    Where the camera moved without rotation, distant objects stay in place, too. Widespread stationary matches that
    agree with the geometry of the others belong to the scene, and all matches are fitted together. Where the moving
    ones have no fit, the reason is the kind of stationary matches. `wide` is `is_widespread` of these.
    """
    x1, x2 = points
    moving = fit(x1[~stationary], x2[~stationary], options, seed)
    if isinstance(moving, Rejected):
        return Rejected(SAME_PHOTO if wide else ONLY_A_LOGO)
    if wide and isinstance(moving, EpipolarFit) and not moving.degeneracy:
        points_in_place = np.asfortranarray(np.hstack([x1[stationary], x2[stationary]]))
        agreeing = (
            squared_distances(points_in_place, np.ascontiguousarray(moving.F).reshape(9)) <= options.max_error_px**2
        )
        if agreeing.mean() >= WATERMARK.explained_share:
            return fit(x1, x2, options, seed)
    inliers, priors = np.zeros(len(x1), bool), np.zeros(len(x1))
    inliers[~stationary], priors[~stationary] = moving.inliers, moving.priors
    return replace(moving, inliers=inliers, priors=priors)


def one_per_cell(points: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Return (C, 2) one point of each occupied cell of a photo; `is_widespread` needs no more of all keypoints."""
    return points[np.unique(_cells(points, size), return_index=True)[1]]


def _cells(points: FloatArray, size: tuple[int, int]) -> IndexArray:
    cells = WATERMARK.cells
    columns, rows = (points / size * cells).astype(np.int64).clip(0, cells - 1).T
    return np.asarray(cells * rows + columns)
