"""Fundamental matrices of pairs of photos, by the chosen estimator; fits of a killed run are reused."""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from sfm_app.atomic_io import mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.geometry.camera import guessed_camera_matrix
from sfm_app.geometry.lenses.bearings import bearings
from sfm_app.hashing import load_arrays
from sfm_app.numerical import FAILURES
from sfm_app.plugins import Estimator
from sfm_app.progress import track
from sfm_app.ransac import FitFundamentalLike
from sfm_app.ransac.degeneracy.watermark import find_stationary, fit_moving, is_widespread, one_per_cell
from sfm_app.ransac.lev_ransac_rays import fit_lev_ransac_rays
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import ordered_map
from sfm_app.settings import EpipolarSettings, Settings
from sfm_app.tasks import Task
from sfm_app.types import Calibration, EpipolarFit, MatchedImage, MatchGraph, PairId, Rejected, ViewGraph

logger = logging.getLogger("sfm_app")

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]


PairFit = tuple[EpipolarFit | Rejected, int]
"""Fit of a pair, or why there is none, and how many of its matches are stationary in the picture."""

PART = 64
"""Pairs per file; after a killed run, finished pairs outside complete files are fitted again."""


def fit_pairs(
    matches: MatchGraph, pairs: Sequence[PairId], run: RunContext, lenses: Mapping[str, Calibration]
) -> dict[PairId, PairFit]:
    """Fit every pair on its own, seeded by the run's seed and its ids.

    Finished pairs stay in `view_graph_parts` until the caller removes it, so that a killed run can resume.

    Args:
        matches: keypoints and raw matches.
        pairs: the pairs to fit.
        run: the run.
        lenses: cameras with a wide lens, by camera group; their pairs are fitted by bearing vectors.
    """
    estimator = run.plugins.estimator(run.settings.epipolar.estimator)
    fit_pair = Task(_fit_pair, estimator, run.settings, dict(lenses))
    return _fit_all(fit_pair, lambda left: _matched_pairs(matches, left), pairs, run)


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPair:
    """All that the fit of a pair needs of the match graph."""

    pair: PairId
    images: tuple[MatchedImage, MatchedImage]
    points: tuple[FloatArray, FloatArray]
    """x1, x2, each (M, 2) pixels."""
    spread: FloatArray
    """(C, 2) one keypoint of the first photo for each of its cells that has any."""


def _matched_pairs(matches: MatchGraph, pairs: Iterable[PairId]) -> Iterator[MatchedPair]:
    """Yield what the fits of these pairs need."""
    spreads: dict[int, FloatArray] = {}
    for pair in pairs:
        first, second = (matches.images[photo] for photo in pair)
        if first.id not in spreads:
            spreads[first.id] = one_per_cell(matches.keypoints[first.id], (first.width, first.height))
        yield MatchedPair(pair, (first, second), matches.points(pair), spreads[first.id])


def _fit_pair(
    estimator: Estimator, settings: Settings, lenses: Mapping[str, Calibration], matched: MatchedPair
) -> PairFit:
    try:
        return _fit_or_raise(estimator, settings, lenses, matched)
    except FAILURES as err:
        logger.info("pair %s could not be fitted", matched.pair, exc_info=err)
        return Rejected("the computation failed"), 0


def _fit_or_raise(
    estimator: Estimator, settings: Settings, lenses: Mapping[str, Calibration], matched: MatchedPair
) -> PairFit:
    seed = int(np.random.SeedSequence([settings.seed, *matched.pair]).generate_state(1)[0])
    points, still = matched.points, _stationary_matches(matched, settings)
    by_rays = ray_estimator(matched.images, lenses)
    fit = by_rays or estimator.fit
    if not still.any():
        return fit(*points, settings.epipolar, seed), 0
    image = matched.images[0]
    wide = is_widespread(points[0][still], matched.spread, (image.width, image.height))
    wide = wide and by_rays is None  # its test needs an F of pixels
    return fit_moving(fit, points, still, wide, settings.epipolar, seed), int(np.count_nonzero(still))


def ray_estimator(images: Sequence[MatchedImage], lenses: Mapping[str, Calibration]) -> FitFundamentalLike | None:
    """Return an estimator by bearing vectors for a pair of photos; None where neither has a wide lens.

    The other camera of a pair is taken as the usual guess.

    Args:
        images: both photos.
        lenses: cameras with a wide lens, by camera group.
    """
    if not any(image.group in lenses for image in images):
        return None
    sizes = [(image.width, image.height) for image in images]
    guesses = [Calibration(guessed_camera_matrix(size), *size, "guess", identifiable=False) for size in sizes]
    cameras = [lenses.get(image.group, guess) for image, guess in zip(images, guesses, strict=True)]

    def fit(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> EpipolarFit | Rejected:
        lines = np.hstack([bearings(x, camera) for x, camera in zip((x1, x2), cameras, strict=True)])
        return fit_lev_ransac_rays(lines, options, seed)

    return fit


def to_view_graph(
    found: Mapping[PairId, PairFit], lenses: Mapping[str, Calibration] = MappingProxyType({})
) -> ViewGraph:
    """Return the view graph of fitted and rejected pairs.

    Args:
        found: fit of every pair, or why it has none.
        lenses: cameras with a wide lens, by camera group.
    """
    return ViewGraph(
        fits={pair: fit for pair, (fit, _) in found.items() if isinstance(fit, EpipolarFit)},
        rejected={pair: fit for pair, (fit, _) in found.items() if isinstance(fit, Rejected)},
        lenses=lenses,
    )


def _fit_all(
    fit_pair: Callable[[MatchedPair], PairFit],
    load: Callable[[Iterable[PairId]], Iterator[MatchedPair]],
    pairs: Sequence[PairId],
    run: RunContext,
) -> dict[PairId, PairFit]:
    """Return the result of `fit_pair` for every pair, in order; each part is written to a file once it is complete."""
    folder = run.workspace.view_graph_parts
    if not resume_or_clear(folder, run.fingerprint):
        mark_unfinished(folder, run.fingerprint)
    parts = {folder / f"{first:06d}.npz": pairs[first : first + PART] for first in range(0, len(pairs), PART)}
    known = {path: read_part(path, part) for path, part in parts.items()}
    left = [pair for path, part in parts.items() if known[path] is None for pair in part]
    fitted = ordered_map(run.executor, fit_pair, load(left), ahead=2 * run.workers)
    results = track(run.progress, fitted, "epipolar geometry", len(left))
    found: dict[PairId, PairFit] = {}
    for path, part in parts.items():
        done = known[path]
        if done is None:
            done = dict(zip(part, results, strict=False))
            write_part(path, done)
        found |= done
    return {pair: found[pair] for pair in pairs}


def write_part(path: Path, found: Mapping[PairId, PairFit]) -> None:
    """Write the results of some pairs.

    Args:
        path: file, written atomically.
        found: fit, or why there is none, and number of stationary matches.
    """
    still = np.array([[*pair, count] for pair, (_, count) in found.items()], np.int64)
    with replace_atomically(path) as beside:
        np.savez(beside, allow_pickle=False, still=still, **to_view_graph(found).to_arrays())


def read_part(path: Path, pairs: Sequence[PairId]) -> dict[PairId, PairFit] | None:
    """Return what `write_part` has written; None where the file is missing or damaged.

    Args:
        path: file; may be missing or damaged.
        pairs: those that it has to hold.
    """
    try:
        arrays = load_arrays(path)
        graph = ViewGraph.from_arrays(arrays)
        every: dict[PairId, EpipolarFit | Rejected] = {**graph.fits, **graph.rejected}
        still = {(int(a), int(b)): int(count) for a, b, count in arrays["still"]}
        return {pair: (every[pair], still[pair]) for pair in pairs}
    except Exception:  # decoders of damaged bytes raise all kinds of errors
        return None


def _stationary_matches(matched: MatchedPair, settings: Settings) -> BoolArray:
    """Return a mask of the matches of a pair that are stationary in the picture; none if the photos differ in size."""
    first, second = matched.images
    if (first.width, first.height) != (second.width, second.height):
        return np.zeros(len(matched.points[0]), bool)
    shrunk = max(first.width, first.height) / settings.matching.max_image_size_px
    return find_stationary(*matched.points, unit_px=max(1.0, shrunk))
