"""Fundamental matrices of pairs of photos, by the chosen estimator; fits of a killed run are reused."""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sfm_app.camera.bearings import SHARES, bearings, deviation_key, field_of_view_deg
from sfm_app.camera.models import camera_matrix, guessed_camera_matrix, panorama_matrix, projection_of_model
from sfm_app.errors import ConfigError
from sfm_app.estimation.given_cameras import assign_cameras, report_checks
from sfm_app.files import load_arrays, mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.fundamental import FitFundamentalLike
from sfm_app.fundamental.degeneracy import find_stationary, fit_moving, is_widespread, one_per_cell
from sfm_app.fundamental.rays import fit_lev_ransac_rays
from sfm_app.numerical import FAILURES
from sfm_app.plugins import Estimator
from sfm_app.progress import track
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import ordered_map
from sfm_app.selfcal.wide_lens import LensEstimate, find_lens, needs_fisheye, shows_panoramas
from sfm_app.settings import EpipolarSettings, Settings
from sfm_app.tasks import Task
from sfm_app.types import Calibration, EpipolarFit, MatchedImage, MatchGraph, PairId, Rejected, ViewGraph
from sfm_app.types.arrays import BoolArray, FloatArray
from sfm_app.types.camera import EQUIRECTANGULAR, FISHEYE

# Wide lenses of camera groups, given or from raw matches: before them, no fundamental matrix fits.

logger = logging.getLogger("sfm_app")


METHOD, PANORAMA = "lens", "panorama"
"""Names of what found a camera: curved epipolar lines, and the photos themselves."""
MAX_DEVIATION = 0.01
"""Largest standard deviation of a radius, as a share of the width, of a lens that counts as determined. Chosen by
hand; not measured on its own."""
TERMS, ANGLES = 4, 200
"""Terms of COLMAP's OPENCV_FISHEYE, and angles at which they are fitted. Counted; chosen by hand."""
NONE_DECIDED: Mapping[str, Calibration | None] = MappingProxyType({})
"""No lens is known from an earlier run."""


def find_lenses(
    matches: MatchGraph, run: RunContext, decided: Mapping[str, Calibration | None] = NONE_DECIDED
) -> dict[str, Calibration]:
    """Find the cameras whose lens no perspective camera describes, by camera group.

    Those that the user gave are taken, and checked against what the matches say.

    Args:
        matches: keypoints and raw matches.
        run: the run.
        decided: wide lenses that an earlier run found, by camera group; None where it found that there is none.

    Raises:
        InputError: the calibration file fits no photo.
        ConfigError: the photos are no panoramas, as the user says.
    """
    _check_panoramas(matches, run)
    given = assign_cameras(matches, run.given, keep=run.settings.calibration.keep)
    if given.notes:
        run.record(given_camera_notes=list(given.notes))
    for note in given.notes:
        run.progress.say(note)
    groups: dict[str, list[MatchedImage]] = {}
    for _, image in sorted(matches.images.items()):
        groups.setdefault(image.group, []).append(image)
    found, checked = {}, {}
    for group, images in groups.items():
        known = given.cameras.get(group)
        if known is not None:
            checked[group] = known, _seen_lens(known, images, matches, run)
            lens = known if known.projection == FISHEYE else None
        else:
            lens = decided[group] if group in decided else _find_lens(images, matches, run)
        if lens is not None:
            found[group] = lens
            run.progress.say(f"the photos {group} are taken with a wide lens: {describe_lens(lens)}")
    report_checks(checked, run)
    run.record(lenses={group: describe_lens(lens) for group, lens in found.items()})
    return found


def describe_lens(lens: Calibration) -> str:
    """Return a wide lens in a few words."""
    if lens.projection == EQUIRECTANGULAR:
        return "panoramas of a whole turn"
    return f"a fisheye with {max(field_of_view_deg(lens)):.0f} degrees along the longer side"


def _find_lens(images: Sequence[MatchedImage], matches: MatchGraph, run: RunContext) -> Calibration | None:
    """Return the camera of a group with a wide lens; None where a perspective camera is enough."""
    size = images[0].width, images[0].height
    if images[0].projection == EQUIRECTANGULAR:
        return panorama(size)
    model = run.settings.scene.camera_model
    if model != "auto":
        asked = projection_of_model(model) == FISHEYE
        return _search_lens(images, matches, run, is_wide=True) if asked else None
    return _search_lens(images, matches, run, is_wide=False) if run.settings.calibration.lens else None


def panorama(size: tuple[int, int]) -> Calibration:
    """Return the camera of panoramas.

    Args:
        size: (width, height) in pixels.
    """
    nothing_open = dict.fromkeys(("fx", "fy", "cx", "cy"), 0.0)
    K = panorama_matrix(size)
    return Calibration(K, *size, PANORAMA, identifiable=True, projection=EQUIRECTANGULAR, spread=nothing_open)


def _seen_lens(
    known: Calibration, images: Sequence[MatchedImage], matches: MatchGraph, run: RunContext
) -> Calibration | None:
    """Return what the matches of a group with a given camera say of its lens; None where they say nothing.

    Of a given perspective camera, they only say something where the lens is a fisheye.
    """
    if not run.settings.calibration.lens:
        return None
    return _search_lens(images, matches, run, is_wide=known.projection == FISHEYE)


def _search_lens(
    images: Sequence[MatchedImage], matches: MatchGraph, run: RunContext, *, is_wide: bool
) -> Calibration | None:
    """Return the lens that the raw matches of a group show; None where there is none, or a perspective one is enough.

    Where it is known to be wide, the best one is returned whether or not it is better than a perspective one.
    """
    size, ids = (images[0].width, images[0].height), {image.id for image in images}
    pairs = [np.hstack(matches.points(pair)) for pair in matches.matches if ids.issuperset(pair)]
    try:
        if not is_wide and shows_panoramas(pairs, size, run.seed):
            return panorama(size)
        found = find_lens(pairs, size, run.seed) if is_wide or needs_fisheye(pairs, size, run.seed) else None
    except FAILURES as err:
        logger.info("the lens of a group could not be found", exc_info=err)
        return None
    return to_calibration(found, size) if found is not None and (is_wide or found.is_fisheye) else None


def _check_panoramas(matches: MatchGraph, run: RunContext) -> None:
    """Check that photos are panoramas where the user says so: no other photo can be one."""
    others = [image.name for image in matches.images.values() if image.projection != EQUIRECTANGULAR]
    if run.settings.scene.camera_model == "EQUIRECTANGULAR" and others:
        raise ConfigError(
            f"{len(others)} photos are no panoramas, such as {others[0]}",
            hint="leave --camera-model EQUIRECTANGULAR out; panoramas are recognized without it",
        )


def to_calibration(found: LensEstimate, size: tuple[int, int]) -> Calibration:
    """Return a lens as the camera that a run uses, with its radius as a polynomial of the angle.

    Args:
        found: the lens in pixels.
        size: (width, height) of the photos.
    """
    lens, side = found.lens, float(max(size))
    corners = np.array([[x, y] for x in (0.0, size[0]) for y in (0.0, size[1])], np.float64)
    farthest = float(np.max(np.hypot(*(corners - np.array(lens.center)).T)))
    theta = np.linspace(0.0, float(lens.angle(np.array([farthest]))[0]), ANGLES + 1)[1:]
    powers = theta[:, None] ** (2.0 * np.arange(1, TERMS + 1) + 1.0)
    terms = np.linalg.lstsq(powers, lens.radius(theta) / lens.focal - theta, rcond=None)[0]
    deviations = np.sqrt(np.diag(np.array(found.covariance)))
    radius_px = float(np.max(found.radius_deviation_px(theta)))
    determined = radius_px <= MAX_DEVIATION * side
    focal_px = float(deviations[0]) * lens.focal
    evidence = {
        "pairs": float(found.pairs), "exponent": lens.exponent, "field_deg": lens.field_deg(side),
        "support": found.support, "support of a perspective lens": found.perspective_support,
        "radius_deviation_px": radius_px,
    } | {deviation_key(share): float(found.radius_deviation_px(share * theta[-1:])[0]) for share in SHARES}  # fmt: skip
    return Calibration(
        camera_matrix(lens.focal, lens.focal, *lens.center), *size, METHOD if determined else "estimate",
        identifiable=determined,
        reason="" if determined else "the pairs determine the lens only roughly",
        projection=FISHEYE,
        fisheye=tuple(terms.tolist()),
        spread={"fx": focal_px, "fy": focal_px, "cx": float(deviations[2]), "cy": float(deviations[3])},
        held=("aspect",),
        evidence=evidence,
    )  # fmt: skip


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
