"""The estimators alone, on matches and on fundamental matrices."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sfm_app.plugins import load_plugins
from sfm_app.ransac import check_points
from sfm_app.selfcal.wide_angle.lens_search import LensEstimate, find_lens
from sfm_app.settings import Settings
from sfm_app.types import Calibration, CameraPairs, EpipolarFit, Rejected


def estimate_fundamental(
    x1: ArrayLike, x2: ArrayLike, method: str = "lev-ransac", seed: int = 0, settings: Settings | None = None
) -> EpipolarFit | Rejected:
    """Estimate the fundamental matrix of one pair of photos from matches, many of which may be wrong.

    Args:
        x1: (N, 2) pixels in photo 1.
        x2: (N, 2) pixels in photo 2; row i matches row i of x1.
        method: name of an estimator; `sfm-app plugins` lists them.
        seed: same seed, same result.
        settings: their table `epipolar` holds the threshold and the limits.

    Returns:
        EpipolarFit, or Rejected (falsy) with the reason when the matches support no geometry.

    Raises:
        ValueError: shapes differ or values are not finite.
        ConfigError: no estimator has that name.

    Examples:
        >>> import sfm_app
        >>> from sfm_app.synthetic.correspondences import PairOptions, make_pair
        >>> pair = make_pair(PairOptions(outliers=0.5), seed=1)
        >>> fit = sfm_app.estimate_fundamental(pair.x1, pair.x2)
        >>> bool(fit), fit.F.shape, fit.degeneracy
        (True, (3, 3), '')
        >>> fit.inliers[pair.is_inlier].mean() > 0.8
        np.True_
    """
    options = (settings or Settings()).epipolar
    return load_plugins().estimator(method).fit(*check_points(x1, x2), options, seed)


def calibrate_fundamentals(
    Fs: ArrayLike, size: tuple[int, int], method: str = "zero-curves", *,
    weights: ArrayLike | None = None, matches: Sequence[ArrayLike] = (), photos: Sequence[tuple[int, int]] = (),
    seed: int = 0, settings: Settings | None = None,
) -> Calibration:  # fmt: skip
    """Find the camera matrix that a set of fundamental matrices shares.

    Args:
        Fs: (P, 3, 3) fundamental matrices in pixels, of pairs taken with one camera.
        size: (width, height) of the photos in pixels.
        method: name of a calibrator; `sfm-app plugins` lists them.
        weights: (P,) > 0, weight of each matrix; None for equal weights.
        matches: per matrix (N, 4) x1, y1, x2, y2 in pixels, the matches behind it; they reveal the lens distortion and
            the accuracy of each matrix.
        photos: per matrix the ids of its two photos.
        seed: same seed, same result.
        settings: their table `calibration` holds the limits.

    Raises:
        ValueError: shapes are wrong or values are not finite.
        ConfigError: no calibrator has that name.

    Examples:
        >>> import sfm_app
        >>> from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
        >>> tracks = make_tracks(TrackOptions(), seed=1)
        >>> camera = sfm_app.calibrate_fundamentals(tracks.F, tracks.size)
        >>> camera.identifiable, f"{camera.K[0, 0] / tracks.K[0, 0, 0]:.2f} times the true focal length"
        (True, '1.00 times the true focal length')
    """
    found = [np.asarray(pair, np.float64) for pair in matches]
    pairs = replace(CameraPairs.from_Fs(Fs, size, weights), photos=tuple(photos), inliers=tuple(found))
    return load_plugins().calibrator(method).calibrate(pairs, (settings or Settings()).calibration, seed)


def estimate_lens(matches: Sequence[ArrayLike], size: tuple[int, int], seed: int = 0) -> LensEstimate | None:
    """Find the focal, projection and center of wide-angle and fisheye photos from the raw matches of their pairs.

    It knows perspective, stereographic, equidistant and equisolid lenses and all between, with fields of view up to
    more than 180 degrees. `is_fisheye` says whether any of them explains more than a perspective lens.

    Args:
        matches: per pair of photos (N, 4) x1, y1, x2, y2 in pixels; half of them may be wrong. At most 16 pairs with 60
            matches or more are used.
        size: (width, height) of all photos in pixels.
        seed: same seed, same result.

    Returns:
        The lens in pixels with its covariance; None where fewer than three pairs agree on one.

    Raises:
        ValueError: shapes are wrong or values are not finite.

    Examples:
        >>> import numpy as np, sfm_app
        >>> from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
        >>> tracks = make_tracks(TrackOptions(), seed=1)
        >>> matches = [np.hstack([pair.x1, pair.x2]) for pair in list(tracks.pairs.values())[:3]]
        >>> sfm_app.estimate_lens(matches, tracks.size).is_fisheye
        False
    """
    found = [np.asarray(pair, np.float64) for pair in matches]
    if any(pair.ndim != 2 or pair.shape[1] != 4 or not np.isfinite(pair).all() for pair in found) or min(size) < 1:
        raise ValueError("matches must be finite arrays of shape (N, 4), and size positive")
    return find_lens(found, size, seed)
