"""The experiments of thesis sections 5.5.3 and 5.9: each yields one set of F's per level for a seed.

An outlying F is fitted to all matches of its pair by the 8-point algorithm, as in the thesis's Figure 5.20; fitted
robustly it would be no outlier. All other F's are LEV-RANSAC's. A seed keeps its cameras, points, noise and clean F's
over all levels, so that the levels of a curve are comparable.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from benchmarks.thesis.chapter5.fits import Fits, FloatArray, robust_fits, with_outlying_fits
from benchmarks.thesis.chapter5.sequences import ImageSequence
from benchmarks.thesis.corners import with_outliers
from sfm_app.synthetic.correspondences import TrackOptions, Tracks, make_tracks
from sfm_app.types.photos import PairId

NOISE_PX = 0.5
"""Noise of all matches; the thesis states the noise for Figure 5.21 only."""
REACH_PX = 256.0
HEAVY_OUTLIER_SHARE = 0.5
"""Share of outliers in an outlying F where the number of outlying F's or frames varies."""
SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
DEVIATIONS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
COUNTS = (0, 2, 4, 6, 8)
RAW_COUNTS = (0, 3, 6, 9, 12)
NOISES_PX = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0)
FRAMES = (4, 5, 6, 8, 10)


class Trial(NamedTuple):
    """The input of a calibrator, and the true camera."""

    x: float
    """Level of the trial on the axis of the figure."""
    fits: Fits
    size: tuple[int, int]
    K: FloatArray
    """(3, 3) true camera matrix."""


def pair_matches(
    tracks: Tracks, outliers: Mapping[PairId, float] | None = None, reach_px: float = REACH_PX, seed: int = 0
) -> Iterator[tuple[PairId, FloatArray]]:
    """Yield each pair of cameras and its matches (N, 4) x1, y1, x2, y2 in pixels; some have shares of outliers."""
    shares = outliers or {}
    for i, j in tracks.pairs:
        rng, x2 = np.random.default_rng([seed, 554, i, j]), tracks.x[j].copy()
        wrong = np.sort(rng.permutation(len(x2))[: round(shares.get((i, j), 0.0) * len(x2))])
        x2[wrong] += rng.uniform(-reach_px, reach_px, (len(wrong), 2))
        yield (i, j), np.column_stack([tracks.x[i], x2])


def matching_outliers(seed: int) -> Iterator[Trial]:
    """Vary the share of outliers in two of ten F's (Figures 5.6a, 5.10a, 5.17a, 5.18a and c)."""
    tracks = make_tracks(TrackOptions(sigma_px=NOISE_PX), seed)
    clean = robust_fits(dict(pair_matches(tracks)), seed)
    chosen = _shuffled_pairs(tracks.pairs, seed)[:2]
    for share in SHARES:
        spoilt = dict(pair_matches(tracks, dict.fromkeys(chosen, share), REACH_PX, seed))
        yield Trial(100 * share, with_outlying_fits(clean, _select(spoilt, chosen)), tracks.size, tracks.K[0])


def focal_deviation(seed: int) -> Iterator[Trial]:
    """Vary the focal length of one of five frames (Figures 5.6b, 5.10b, 5.17b, 5.18b and d)."""
    for deviation in DEVIATIONS:
        tracks = make_tracks(TrackOptions(sigma_px=NOISE_PX, other_focal=1.0 + deviation), seed)
        yield Trial(100 * deviation, robust_fits(dict(pair_matches(tracks)), seed), tracks.size, tracks.K[0])


def outlying_matrices(seed: int) -> Iterator[Trial]:
    """Vary the number of outlying F's, each from 50 % outliers (Figure 5.19a)."""
    tracks = make_tracks(TrackOptions(sigma_px=NOISE_PX), seed)
    clean = robust_fits(dict(pair_matches(tracks)), seed)
    order = _shuffled_pairs(tracks.pairs, seed)
    spoilt = dict(pair_matches(tracks, dict.fromkeys(order, HEAVY_OUTLIER_SHARE), REACH_PX, seed))
    for count in COUNTS:
        yield Trial(count, with_outlying_fits(clean, _select(spoilt, order[:count])), tracks.size, tracks.K[0])


def outlying_corners(sequence: ImageSequence, seed: int) -> Iterator[Trial]:
    """Vary the number of outlying F's, with the corners of a real sequence (Figure 5.19b)."""
    clean = robust_fits(sequence.matches, seed)
    order = _shuffled_pairs(clean, seed)
    spoilt = {}
    for number, pair in enumerate(order):
        rows = sequence.matches[pair]
        moved, _ = with_outliers(rows[:, 2:], HEAVY_OUTLIER_SHARE, REACH_PX, 100 * seed + number)
        spoilt[pair] = np.column_stack([rows[:, :2], moved])
    for count in COUNTS:
        yield Trial(count, with_outlying_fits(clean, _select(spoilt, order[:count])), sequence.size, sequence.K)


def raw_pairs(sequence: ImageSequence, seed: int) -> Iterator[Trial]:
    """Vary the number of F's that are fitted to all raw matches, with seven photos (Figure 5.20)."""
    seven = sequence.first(7)
    clean = robust_fits(seven.matches, seed)
    order = _shuffled_pairs(clean, seed)
    for count in RAW_COUNTS:
        yield Trial(count, with_outlying_fits(clean, _select(seven.matches, order[:count])), sequence.size, sequence.K)


def gaussian_noise(seed: int) -> Iterator[Trial]:
    """Vary the noise of all matches, without outliers (Figure 5.21)."""
    for sigma_px in NOISES_PX:
        tracks = make_tracks(TrackOptions(sigma_px=sigma_px), seed)
        yield Trial(sigma_px, robust_fits(dict(pair_matches(tracks)), seed), tracks.size, tracks.K[0])


def noisy_frame(seed: int) -> Iterator[Trial]:
    """Vary the number of frames; all F's with the last one are outlying, from 50 % outliers (Figure 5.22a)."""
    for count in FRAMES:
        tracks = make_tracks(TrackOptions(sigma_px=NOISE_PX, cameras=count), seed)
        clean = robust_fits(dict(pair_matches(tracks)), seed)
        chosen = [pair for pair in tracks.pairs if count - 1 in pair]
        spoilt = dict(pair_matches(tracks, dict.fromkeys(chosen, HEAVY_OUTLIER_SHARE), REACH_PX, seed))
        yield Trial(count, with_outlying_fits(clean, _select(spoilt, chosen)), tracks.size, tracks.K[0])


def clean_frames(seed: int) -> Iterator[Trial]:
    """Vary the number of frames, without outliers: for the computation times (Figure 5.22b)."""
    for count in FRAMES:
        tracks = make_tracks(TrackOptions(sigma_px=NOISE_PX, cameras=count), seed)
        yield Trial(count, robust_fits(dict(pair_matches(tracks)), seed), tracks.size, tracks.K[0])


def whole_sequence(sequence: ImageSequence, seed: int) -> Iterator[Trial]:
    """Yield all pairs of a real sequence (Tables 5.2 and 5.3)."""
    yield Trial(0, robust_fits(sequence.matches, seed), sequence.size, sequence.K)


def _shuffled_pairs(pairs: Mapping[PairId, object], seed: int) -> list[PairId]:
    names = list(pairs)
    return [names[k] for k in np.random.default_rng([seed, 59]).permutation(len(names))]


def _select(rows: Mapping[PairId, FloatArray], chosen: list[PairId]) -> dict[PairId, FloatArray]:
    return {pair: rows[pair] for pair in chosen}
