"""Fundamental matrices of pairs of photos, by the chosen estimator; fits of a killed run are reused."""

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sfm_app.camera.bearings import SHARES, bearings, deviation_key, field_of_view_deg
from sfm_app.camera.models import camera_matrix, guessed_camera_matrix, panorama_camera, projection_of_model
from sfm_app.errors import ConfigError
from sfm_app.estimation.given_cameras import given_cameras, report_checks
from sfm_app.files import load_arrays, mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.fundamental.degeneracy import Fit, find_stationary, fit_moving, is_widespread, one_per_cell
from sfm_app.fundamental.rays import fit_lev_ransac_rays
from sfm_app.numerical import FAILURES
from sfm_app.plugins import Estimator
from sfm_app.progress import track
from sfm_app.runtime.context import Earlier, RunContext
from sfm_app.runtime.parallel import ordered_map
from sfm_app.selfcal.wide_lens import LensEstimate, find_lens, needs_fisheye, shows_panoramas
from sfm_app.settings import EpipolarSettings, Settings
from sfm_app.tasks import Task
from sfm_app.types import Calibration, EpipolarGeometry, MatchedImage, MatchGraph, PairId, RayFit, Rejected, ViewGraph
from sfm_app.types.arrays import BoolArray, FloatArray
from sfm_app.types.camera import EQUIRECTANGULAR, FISHEYE

logger = logging.getLogger("sfm_app")

METHOD = "lens"
"""Source of a camera: curved epipolar lines."""


class LENS:
    """A fisheye as a camera of COLMAP."""

    max_deviation: float = 0.01
    """Standard deviation of a radius up to which a lens is determined, as a share of the width. Chosen by hand."""
    terms: int = 4
    """Terms of COLMAP's OPENCV_FISHEYE. By definition."""
    angles: int = 200
    """Angles at which the terms are fitted. Chosen by hand."""


NONE_KNOWN: Mapping[str, Calibration | None] = MappingProxyType({})

PairFit = tuple[EpipolarGeometry | Rejected, int]
"""Fit of a pair, or why there is none, and the number of its matches that are stationary in the picture."""

PART = 64
"""Pairs per file; after a killed run, finished pairs outside complete files are fitted again."""

# Wide lenses of camera groups, given or from raw matches: without them, no fundamental matrix fits.


def find_lenses(
    matches: MatchGraph, run: RunContext, known_lenses: Mapping[str, Calibration | None] = NONE_KNOWN
) -> dict[str, Calibration]:
    """Find the cameras whose lens no perspective camera describes, by camera group.

    Given cameras are taken, and checked against the matches. `known_lenses` are those of an earlier run, None for no
    wide lens. InputError if the calibration file fits no photo; ConfigError if stated panoramas are none.
    """
    others = [image.name for image in matches.images.values() if image.projection != EQUIRECTANGULAR]
    if run.settings.scene.camera_model == "EQUIRECTANGULAR" and others:
        raise ConfigError(
            f"{len(others)} photos are not panoramas, such as {others[0]}",
            hint="omit --camera-model EQUIRECTANGULAR; panoramas are detected automatically",
        )
    given = given_cameras(matches, run)
    if given.notes:
        run.record(given_camera_notes=list(given.notes))
    for note in given.notes:
        run.progress.say(note)
    lenses, checked = {}, {}
    for group, images in matches.groups.items():
        given_camera = given.cameras.get(group)
        if given_camera is not None:
            is_wide = given_camera.projection == FISHEYE
            searched = run.settings.calibration.lens
            checked[group] = given_camera, _search_lens(images, matches, run, is_wide=is_wide) if searched else None
            lens = given_camera if is_wide else None
        else:
            lens = known_lenses[group] if group in known_lenses else _find_lens(images, matches, run)
        if lens is not None:
            lenses[group] = lens
            run.progress.say(f"the photos {group} have a wide lens: {describe_lens(lens)}")
    report_checks(checked, run)
    run.record(lenses={group: describe_lens(lens) for group, lens in lenses.items()})
    return lenses


def describe_lens(lens: Calibration) -> str:
    """Describe a wide lens in a few words."""
    if lens.projection == EQUIRECTANGULAR:
        return "equirectangular panoramas"
    return f"a fisheye with {max(field_of_view_deg(lens)):.0f} degrees along the longer side"


def _find_lens(images: Sequence[MatchedImage], matches: MatchGraph, run: RunContext) -> Calibration | None:
    """Return the camera of a group with a wide lens; None where a perspective camera is enough."""
    size = images[0].width, images[0].height
    if images[0].projection == EQUIRECTANGULAR:
        return panorama_camera(size)
    model = run.settings.scene.camera_model
    if model != "auto":
        is_fisheye = projection_of_model(model) == FISHEYE
        return _search_lens(images, matches, run, is_wide=True) if is_fisheye else None
    return _search_lens(images, matches, run, is_wide=False) if run.settings.calibration.lens else None


def _search_lens(
    images: Sequence[MatchedImage], matches: MatchGraph, run: RunContext, *, is_wide: bool
) -> Calibration | None:
    """Return the lens that raw matches show; None without one. Unless `is_wide`, a perspective lens may be enough."""
    size, ids = (images[0].width, images[0].height), {image.id for image in images}
    pairs = [np.hstack(matches.points(pair)) for pair in matches.matches if ids.issuperset(pair)]
    try:
        if not is_wide and shows_panoramas(pairs, size, run.seed):
            return panorama_camera(size)
        estimate = find_lens(pairs, size, run.seed) if is_wide or needs_fisheye(pairs, size, run.seed) else None
    except FAILURES as err:
        logger.info("the lens of a group could not be estimated", exc_info=err)
        return None
    return to_calibration(estimate, size) if estimate is not None and (is_wide or estimate.is_fisheye) else None


def to_calibration(estimate: LensEstimate, size: tuple[int, int]) -> Calibration:
    """Return a lens as the camera of a run, with its radius as a polynomial of the angle; size in pixels."""
    lens, side = estimate.lens, float(max(size))
    corners = np.array([[x, y] for x in (0.0, size[0]) for y in (0.0, size[1])], np.float64)
    farthest = float(np.max(np.hypot(*(corners - np.array(lens.center)).T)))
    theta = np.linspace(0.0, float(lens.angle(np.array([farthest]))[0]), LENS.angles + 1)[1:]
    powers = theta[:, None] ** (2.0 * np.arange(1, LENS.terms + 1) + 1.0)
    k1, k2, k3, k4 = np.linalg.lstsq(powers, lens.radius(theta) / lens.focal - theta, rcond=None)[0].tolist()
    deviations = np.sqrt(np.diag(np.array(estimate.covariance)))
    radius_px = float(np.max(estimate.radius_deviation_px(theta)))
    determined = radius_px <= LENS.max_deviation * side
    focal_px = float(deviations[0]) * lens.focal
    evidence = {
        "pairs": float(estimate.pairs), "exponent": lens.exponent, "field_deg": lens.field_deg(side),
        "support": estimate.support, "support of a perspective lens": estimate.perspective_support,
        "radius_deviation_px": radius_px,
    }  # fmt: skip
    evidence |= {deviation_key(share): float(estimate.radius_deviation_px(share * theta[-1:])[0]) for share in SHARES}
    return Calibration(
        camera_matrix(lens.focal, lens.focal, *lens.center), *size, METHOD if determined else "estimate",
        identifiable=determined,
        reason="" if determined else "the pairs determine the lens only roughly",
        projection=FISHEYE,
        distortion=(k1, k2, 0.0, 0.0, k3, k4),
        spread={"fx": focal_px, "fy": focal_px, "cx": float(deviations[2]), "cy": float(deviations[3])},
        held=("aspect",),
        evidence=evidence,
    )  # fmt: skip


def find_views(
    matches: MatchGraph,
    run: RunContext,
    lenses: Mapping[str, Calibration],
    known: Mapping[PairId, EpipolarGeometry | Rejected] = MappingProxyType({}),
) -> ViewGraph:
    """Return the geometry of every pair with matches; those that are not known are fitted."""
    fitted = fit_pairs(matches, [pair for pair in matches.matches if pair not in known], run, lenses)
    graph = to_view_graph({pair: fitted.get(pair) or (known[pair], 0) for pair in matches.matches}, lenses)
    run.record(
        kept=len(graph.fits),
        rejected=graph.reasons,
        degenerate=sum(bool(fit.degeneracy) for fit in graph.fits.values()),
        inliers=sum(fit.inlier_count for fit in graph.fits.values()),
        stationary=sum(count for _, count in fitted.values()),
    )
    return graph


def fit_pairs(
    matches: MatchGraph, pairs: Sequence[PairId], run: RunContext, lenses: Mapping[str, Calibration]
) -> dict[PairId, PairFit]:
    """Fit every pair, seeded by the run and the ids of its photos; those of wide lenses by bearing vectors."""
    estimator = run.plugins.estimator(run.settings.epipolar.estimator)
    fit_pair = Task(_fit_pair, estimator, run.settings, dict(lenses))
    return _fit_all(fit_pair, lambda missing: _matched_pairs(matches, missing), pairs, run)


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPair:
    """Part of the match graph for the fit of a pair."""

    pair: PairId
    images: tuple[MatchedImage, MatchedImage]
    points: tuple[FloatArray, FloatArray]
    """x1, x2, each (M, 2) pixels."""
    spread: FloatArray
    """(C, 2) one keypoint of the first photo for each of its cells that has any."""


def _matched_pairs(matches: MatchGraph, pairs: Iterable[PairId]) -> Iterator[MatchedPair]:
    spreads: dict[int, FloatArray] = {}
    for pair in pairs:
        first, second = (matches.images[photo] for photo in pair)
        if first.id not in spreads:
            spreads[first.id] = one_per_cell(matches.keypoints[first.id], (first.width, first.height))
        yield MatchedPair(pair, (first, second), matches.points(pair), spreads[first.id])


def _fit_pair(
    estimator: Estimator, settings: Settings, lenses: Mapping[str, Calibration], matched: MatchedPair
) -> PairFit:
    points, image = matched.points, matched.images[0]
    try:
        seed = int(np.random.SeedSequence([settings.seed, *matched.pair]).generate_state(1)[0])
        stationary = _stationary_matches(matched, settings)
        by_rays = ray_estimator(matched.images, lenses)
        fit = by_rays or estimator.fit
        if not stationary.any():
            return fit(*points, settings.epipolar, seed), 0
        wide = is_widespread(points[0][stationary], matched.spread, (image.width, image.height))
        wide = wide and by_rays is None  # its test needs an F of pixels
        return fit_moving(fit, points, stationary, wide, settings.epipolar, seed), int(np.count_nonzero(stationary))
    except FAILURES as err:
        logger.info("pair %s could not be fitted", matched.pair, exc_info=err)
        return Rejected("the computation failed"), 0


def ray_estimator(images: Sequence[MatchedImage], lenses: Mapping[str, Calibration]) -> Fit | None:
    """Return an estimator by bearing vectors for a pair; None without a wide lens. The other camera is a guess."""
    if not any(image.group in lenses for image in images):
        return None
    sizes = [(image.width, image.height) for image in images]
    guesses = [Calibration(guessed_camera_matrix(size), *size, "guess", identifiable=False) for size in sizes]
    cameras = [lenses.get(image.group, guess) for image, guess in zip(images, guesses, strict=True)]

    def fit(x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int) -> RayFit | Rejected:
        lines = np.hstack([bearings(x, camera) for x, camera in zip((x1, x2), cameras, strict=True)])
        return fit_lev_ransac_rays(lines, options, seed)

    return fit


def to_view_graph(
    results: Mapping[PairId, PairFit], lenses: Mapping[str, Calibration] = MappingProxyType({})
) -> ViewGraph:
    """Return the view graph of fitted and rejected pairs."""
    return ViewGraph(
        fits={pair: fit for pair, (fit, _) in results.items() if isinstance(fit, EpipolarGeometry)},
        rejected={pair: fit for pair, (fit, _) in results.items() if isinstance(fit, Rejected)},
        lenses=lenses,
    )


def _fit_all(
    fit_pair: Callable[[MatchedPair], PairFit],
    load: Callable[[Iterable[PairId]], Iterator[MatchedPair]],
    pairs: Sequence[PairId],
    run: RunContext,
) -> dict[PairId, PairFit]:
    """Return the result of `fit_pair` for every pair, in order; each complete part is written to a file."""
    folder = run.workspace.view_graph_parts
    if not resume_or_clear(folder, run.fingerprint):
        mark_unfinished(folder, run.fingerprint)
    parts = {folder / f"{first:06d}.npz": pairs[first : first + PART] for first in range(0, len(pairs), PART)}
    stored = {path: read_part(path, part) for path, part in parts.items()}
    missing = [pair for path, part in parts.items() if stored[path] is None for pair in part]
    fitted = ordered_map(run.executor, fit_pair, load(missing), ahead=2 * run.workers)
    results = track(run.progress, fitted, "epipolar geometry", len(missing))
    fits: dict[PairId, PairFit] = {}
    for path, part in parts.items():
        finished = stored[path]
        if finished is None:
            finished = dict(zip(part, results, strict=False))
            write_part(path, finished)
        fits |= finished
    return {pair: fits[pair] for pair in pairs}


def write_part(path: Path, results: Mapping[PairId, PairFit]) -> None:
    """Write the results of some pairs to a file, atomically."""
    still = np.array([[*pair, count] for pair, (_, count) in results.items()], np.int64)
    with replace_atomically(path) as beside:
        np.savez(beside, allow_pickle=False, still=still, **to_view_graph(results).to_arrays())


def read_part(path: Path, pairs: Sequence[PairId]) -> dict[PairId, PairFit] | None:
    """Read the results of these pairs by `write_part`; None where the file is missing or damaged."""
    try:
        arrays = load_arrays(path)
        graph = ViewGraph.from_arrays(arrays)
        results = graph.results
        still = {(int(a), int(b)): int(count) for a, b, count in arrays["still"]}
        return {pair: (results[pair], still[pair]) for pair in pairs}
    except Exception:  # decoders of damaged bytes raise all kinds of errors
        return None


def _stationary_matches(matched: MatchedPair, settings: Settings) -> BoolArray:
    first, second = matched.images
    if (first.width, first.height) != (second.width, second.height):
        return np.zeros(len(matched.points[0]), bool)
    shrunk = max(first.width, first.height) / settings.matching.max_image_size_px
    return find_stationary(*matched.points, unit_px=max(1.0, shrunk))


# Wide lenses and fundamental matrices of an earlier run.


def mostly_known_groups(matches: MatchGraph, earlier: Earlier) -> dict[str, list[MatchedImage]]:
    """Return the photos of the camera groups with most photos known."""
    groups = matches.groups
    known = {group: sum(image.name in earlier.known for image in images) for group, images in groups.items()}
    return {group: images for group, images in groups.items() if known[group] > 0.5 * len(images)}


def known_lenses(matches: MatchGraph, before: ViewGraph, earlier: Earlier) -> dict[str, Calibration | None]:
    """Return the lenses of mostly known camera groups in the earlier view graph: wide ones, None for the usual ones."""
    return {group: before.lenses.get(group) for group in mostly_known_groups(matches, earlier)}


def known_fits(
    matches: MatchGraph, before: ViewGraph, same: Collection[PairId], lenses: Mapping[str, Calibration]
) -> dict[PairId, EpipolarGeometry | Rejected]:
    """Return the fits of pairs with the same matches and lenses."""
    groups = {image.group for image in matches.images.values()}
    unchanged = {group for group in groups if _text(before.lenses.get(group)) == _text(lenses.get(group))}
    results = before.results
    return {p: results[p] for p in same if p in results and all(matches.images[k].group in unchanged for k in p)}


def _text(lens: Calibration | None) -> str:
    return "" if lens is None else str(lens.to_dict())
