"""One attempt to map a group: pairs to start from, COLMAP's mappers, and how well a model explains its matches."""

import contextlib
import logging
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.bearings import bearings, plane_points
from sfm_app.colmap.backend import Cancellation, CancellationToken, Reconstruction, run_interruptible, translate_errors
from sfm_app.colmap.mapping import copy_database, incremental_options, map_globally, map_incrementally
from sfm_app.colmap.model import model_from_seed, placed_views
from sfm_app.errors import BackendError
from sfm_app.geometry.epipolar import GOOD_ANGLE_DEG, TwoViewSeed, cross_matrix, ray_seed, two_view_seed
from sfm_app.numerical import FAILURES, error_reason
from sfm_app.posegraph.pair_pose import is_in_front, pose_distances, ray_angles_deg
from sfm_app.retrieval import choose_by_rank
from sfm_app.runtime.context import RunContext
from sfm_app.types import Calibration, Intrinsics, MatchGraph, PairId, PoseGraph, RelativePose, ViewGraph
from sfm_app.types.arrays import FloatArray
from sfm_app.types.camera import PERSPECTIVE

# Pairs of photos that a mapping can start from, best first.

DISSENT_WEIGHT = 0.1
"""Weight of a seed whose pair contradicts the camera matrix that other pairs agree on."""
PLANAR_WEIGHT = 0.5
"""Weight of a seed whose points lie on a plane, or whose camera moved along its axis: its pose is less certain."""
FORWARD = 0.95
"""Share of the translation along the camera's axis above which the motion counts as forward."""
GRID = 8
"""Number of cells across and down a photo, for its coverage: spread points make a better start than a cluster."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pair of photos that mapping may start from."""

    pair: PairId
    pose: RelativePose
    score: float


def rank_seeds(
    matches: MatchGraph, graph: PoseGraph, intrinsics: Intrinsics, photos: Sequence[int], min_angle_deg: float
) -> list[Candidate]:
    """Return candidates for the first pair, best first: many well-spread points, wide angles, consistent with K.

    Args:
        matches: keypoints and raw matches.
        graph: relative poses.
        intrinsics: cameras from pairs.
        photos: ids of the group; both photos of a candidate belong to it.
        min_angle_deg: smallest median triangulation angle, degrees.
    """
    members, found = set(photos), []
    for pair, pose in graph.poses.items():
        if members.issuperset(pair) and pose.kind != "rotation" and pose.angle_deg >= min_angle_deg:
            cameras = [intrinsics.camera(matches.images[photo]) for photo in pair]
            worth = coverage(matches, pair, pose) * agreement(pair, cameras)
            worth *= PLANAR_WEIGHT if pose.kind == "planar" or abs(pose.t[2]) > FORWARD else 1.0
            score = pose.inlier_count * min(pose.angle_deg / GOOD_ANGLE_DEG, 1.0) * pose.in_front**4 * worth
            found.append(Candidate(pair, pose, score))
    return sorted(found, key=lambda candidate: (-candidate.score, candidate.pair))


def triangulate_seed(matches: MatchGraph, candidate: Candidate, intrinsics: Intrinsics) -> TwoViewSeed:
    """Return the pose and triangulated points of a candidate.

    Args:
        matches: keypoints and raw matches.
        candidate: pair and pose.
        intrinsics: cameras from pairs.
    """
    pose, cameras = candidate.pose, [intrinsics.camera(matches.images[photo]) for photo in candidate.pair]
    points = matches.points(candidate.pair)
    if any(camera.projection != PERSPECTIVE for camera in cameras):
        lines = np.hstack([bearings(x[pose.inliers], camera) for x, camera in zip(points, cameras, strict=True)])
        return ray_seed(pose.R, pose.t, lines)
    x1, x2 = (plane_points(x[pose.inliers], camera) for x, camera in zip(points, cameras, strict=True))
    return two_view_seed(cross_matrix(pose.t) @ pose.R, x1, x2)


def agreement(pair: PairId, cameras: Sequence[Calibration]) -> float:
    """Return the weight of a pair: 1 unless it contradicts the camera that other pairs agree on.

    Args:
        pair: ids of two photos.
        cameras: cameras of the two photos.
    """
    first, second = cameras
    unknown = first is not second or not first.key_pairs
    return 1.0 if unknown or pair in first.key_pairs else DISSENT_WEIGHT


def coverage(matches: MatchGraph, pair: PairId, pose: RelativePose) -> float:
    """Return the share of cells with an inlier, of those that the inliers could fill; geometric mean of both photos.

    Args:
        matches: keypoints and raw matches.
        pair: ids of two photos.
        pose: relative pose of the pair, with its inliers.
    """
    shares = []
    for photo, x in zip(pair, matches.points(pair), strict=True):
        image = matches.images[photo]
        cells = (x[pose.inliers] / [image.width, image.height] * GRID).astype(np.int64).clip(0, GRID - 1)
        filled = len(np.unique(cells[:, 0] * GRID + cells[:, 1]))
        shares.append(filled / min(GRID * GRID, max(pose.inlier_count, 1)))
    return float(np.sqrt(shares[0] * shares[1]))


# Score how well a model explains the matches, independently of how the model was made.
#
# For every pair of posed photos, the raw matches are counted that lie on the epipolar lines of the model, in front
# of both cameras. Points, tracks and reprojection errors depend on the mapper; this count does not.

LOOSE_FACTOR = 2.0
"""Largest error of an explained match, in inlier thresholds: models are not adjusted to each pair."""
SATURATION = 100.0
"""Number of matches at which the support of a pair reaches half of its limit; beyond it, more matches add little."""


@dataclass(frozen=True, slots=True)
class PairSupport:
    """Numbers of matches of a pair that a model explains or contradicts."""

    matches: int
    """Raw matches that the model explains."""
    inliers: int
    """Inliers of the fundamental matrix of the pair."""
    contradicted: int
    """Inliers that the model does not explain."""


def explained_pairs(
    model: Reconstruction, matches: MatchGraph, views: ViewGraph, max_error_px: float
) -> dict[PairId, PairSupport]:
    """Return how well a model explains every pair of its photos.

    Args:
        model: COLMAP's reconstruction.
        matches: keypoints and raw matches.
        views: fundamental matrices.
        max_error_px: largest Sampson distance of an inlier.
    """
    found = {}
    for pair, seen in _placed_pairs(model, matches):
        right = seen.inlier_mask(LOOSE_FACTOR * max_error_px)
        fit = views.fits.get(pair)
        wrong = int(np.count_nonzero(fit.inliers & ~right)) if fit else 0
        found[pair] = PairSupport(int(np.count_nonzero(right)), fit.inlier_count if fit else 0, wrong)
    return found


def model_poses(
    model: Reconstruction, matches: MatchGraph, max_error_px: float, least: int
) -> dict[PairId, RelativePose]:
    """Return the relative poses of a model for all pairs of its photos with enough explained matches.

    Args:
        model, matches, max_error_px: as in `explained_pairs`.
        least: smallest number of explained matches of a pair.
    """
    found = {}
    for pair, seen in _placed_pairs(model, matches):
        right = seen.inlier_mask(max_error_px)
        if np.count_nonzero(right) >= least:
            angle_deg = float(np.median(ray_angles_deg(seen.lines[right], seen.R)))
            found[pair] = RelativePose(seen.R, seen.t, right, angle_deg=angle_deg, in_front=1.0, kind="calibrated")
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _PlacedPair:
    """The raw matches of two posed photos."""

    lines: FloatArray
    """(M, 18) matches as bearing vectors of view 1 and of view 2."""
    R: FloatArray
    t: FloatArray
    """Rotation and translation, view 2 from view 1; t has length 1, or is 0 for equal positions."""

    def inlier_mask(self, max_error_px: float) -> NDArray[np.bool_]:
        """Return (M,) which matches lie on their epipolar lines, in front of both cameras."""
        distances = pose_distances(self.lines, self.R, self.t)
        return np.asarray((distances <= max_error_px) & is_in_front(self.lines, self.R, self.t), bool)


def _placed_pairs(model: Reconstruction, matches: MatchGraph) -> Iterator[tuple[PairId, _PlacedPair]]:
    placed = placed_views(model, matches.keypoints)
    for pair, rows in matches.matches.items():
        if pair[0] not in placed or pair[1] not in placed:
            continue
        first, second = placed[pair[0]], placed[pair[1]]
        R = second.R @ first.R.T
        t = second.t - R @ first.t
        lines = np.hstack([first.lines[rows[:, 0]], second.lines[rows[:, 1]]])
        yield pair, _PlacedPair(lines, R, t / max(float(np.linalg.norm(t)), 1e-300))


def support(explained: Mapping[PairId, PairSupport]) -> float:
    """Return the score of a model: its explained matches, of which each further one of a pair counts less."""
    return float(np.sum(saturate([pair.matches for pair in explained.values()])))


def saturate(matches: Sequence[int]) -> FloatArray:
    """Return what the matches of pairs count in a score, (N,): each further match of a pair counts less.

    Args:
        matches: of each pair.
    """
    counts = np.array(matches, np.float64)
    return np.asarray(counts / (1.0 + counts / SATURATION))


# Reasons why photos have no pose.

MANY, FEW_LOST = 60, 0.05
"""In sets of at least this many photos, a smaller share of unregistered ones is not worth another reconstruction."""


def are_worth_another_try(lost: int, photos: int) -> bool:
    """Return whether photos without a place justify mapping all of them once more.

    Args:
        lost: photos without a place.
        photos: photos of the set.
    """
    return lost > 0 and (photos < MANY or lost >= FEW_LOST * photos)


def unregistered_reasons(
    posed: set[int], others: Sequence[Sequence[int]], matches: MatchGraph, views: ViewGraph, graph: PoseGraph
) -> dict[str, str]:
    """Return why each photo is missing in the main model, by name.

    Args:
        posed: photos of the main model.
        others: photos of each of the other models.
        matches: all photos.
        views: fundamental matrices.
        graph: consistent relative poses, and why others were dropped.
    """
    reasons = {}
    for photo, image in matches.images.items():
        if photo not in posed:
            model = next((model for model in others if photo in model), None)
            if model:
                reasons[image.name] = f"belongs to another model, of {len(model)} photos"
            elif not len(matches.keypoints[photo]):
                reasons[image.name] = "no features were found in it"
            else:
                reasons[image.name] = _reason(photo, posed, views, graph)
    return reasons


def _reason(photo: int, posed: set[int], views: ViewGraph, graph: PoseGraph) -> str:
    edges = dict(_edges(photo, views))
    to_posed = {other: count for other, count in edges.items() if other in posed}
    if to_posed:
        nearest = max(to_posed, key=lambda other: (to_posed[other], -other))
        contradiction = graph.dropped.get((min(photo, nearest), max(photo, nearest)))
        because = f", but that pair was dropped: {contradiction}" if contradiction else ""
        return f"could not be placed: {to_posed[nearest]} inliers with the nearest placed photo{because}"
    return (
        "shares inliers only with photos that have no place either" if edges else "shares no scene with any other photo"
    )


def _edges(photo: int, views: ViewGraph) -> Iterator[tuple[int, int]]:
    for pair, fit in views.fits.items():
        if photo in pair:
            yield pair[pair[0] == photo], fit.inlier_count


def photo_names(photos: Sequence[int], matches: MatchGraph) -> list[str]:
    """Return the names of photos.

    Args:
        photos: ids.
        matches: knows the names.
    """
    return [matches.images[photo].name for photo in photos]


# COLMAP's two mappers on one group of photos, side by side, and the choice of the better model.

logger = logging.getLogger("sfm_app")

ENOUGH_SHARE = 0.9
"""A model with this share of the photos of its group ends the search for a better seed."""
CONFIRMED_SHARE = 0.5
"""This share is enough when two seeds agree on how many photos can be placed."""
MIN_PHOTOS = 3
"""Smallest number of photos from which a camera is learned, and in a group that is mapped besides the main one."""
MIN_GLOBAL_PHOTOS = 3
"""Smallest number of photos for the global mapper: the positions of two photos do not determine a scale."""
EQUAL_TOLERANCE = 0.01
"""Models whose supports differ by less than this share count as equal; the one with most photos and points is taken."""
MAX_CONTRADICTED_SHARE = 0.01
"""Share of the inliers of fundamental matrices that may contradict a complete model before others are tried."""
MAX_FOCAL_DEVIATION = 0.01
"""Relative standard deviation of a focal up to which mapping holds it fixed."""
MOST_FULLY_MAPPED, MAPPED_PARTNERS = 250, 16
"""Photos up to which mapping uses all pairs, and partners of each photo above. Chosen by hand."""
MOST_DROPPED = 0.05
"""Share of the pairs of a group that the pose graph may have dropped where the incremental mapper is given time to do
without the other one. It decides when that begins, and nothing else. Chosen by hand."""
INCREMENTAL_FOLDER, GLOBAL_FOLDER = "incremental", "global"


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """A connected group of photos, with their matches, geometry and cameras."""

    photos: Sequence[int]
    matches: MatchGraph
    views: ViewGraph
    graph: PoseGraph
    intrinsics: Intrinsics


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """A model that a mapper made of a group, and the matches that it explains."""

    mapper: str
    model: Reconstruction
    explained: dict[PairId, PairSupport]
    note: str
    """How it was made, and how many photos it holds; for people."""

    @property
    def photos(self) -> int:
        """Number of posed photos."""
        return self.model.num_reg_images()

    @property
    def support(self) -> float:
        """Score of the model, see `support.support`."""
        return support(self.explained)


@dataclass(frozen=True, slots=True)
class NoModel:
    """Why a mapper gave no model, or one with too few points."""

    mapper: str
    note: str
    """As in `Attempt`."""


MappingResult: TypeAlias = Attempt | NoModel
"""Result of a mapper."""
Maker: TypeAlias = Callable[[CancellationToken], list[MappingResult]]
"""Function that makes models until a token stops it."""


class StopSignal:
    """Token that stops a mapper when the whole run is stopped, or when its model is no longer needed."""

    def __init__(self, token: Cancellation) -> None:
        self.token, self.needless = token, False

    @property
    def is_cancelled(self) -> bool:
        """Whether to stop."""
        return self.needless or self.token.is_cancelled


def pairs_to_map(graph: PoseGraph) -> PoseGraph:
    """Return the pose graph with as many pairs as mapping needs; all of them in small sets.

    Tracks join along a few pairs of each photo. COLMAP follows all pairs of every point again and again.

    Args:
        graph: relative poses.
    """
    photos = {photo for pair in graph.poses for photo in pair}
    if len(photos) <= MOST_FULLY_MAPPED:
        return graph
    counts = {pair: pose.inlier_count for pair, pose in graph.poses.items()}
    chosen = choose_by_rank(counts, 0, MAPPED_PARTNERS)
    return replace(graph, poses={pair: pose for pair, pose in graph.poses.items() if pair in chosen})


def map_group(
    group: Group, run: RunContext, is_settled: Callable[[Attempt], bool] = lambda _: False
) -> list[MappingResult]:
    """Return the results of the mappers on a group.

    The incremental mapper from the best seed and the global mapper run side by side, or one after the other where the
    first will probably do. Where neither places most photos, the next seeds are tried. The results do not depend on
    which mapper ends first: a complete, uncontradicted incremental model discards the global one, whether or not that
    is finished.

    Args:
        group: a connected group of photos, with their matches and poses.
        run: the run.
        is_settled: whether an incremental model says enough, although it is incomplete or contradicted.
    """
    options = run.settings.scene
    at_once = options.mapper != "incremental" and len(group.photos) >= MIN_GLOBAL_PHOTOS
    seeds = rank_seeds(group.matches, group.graph, group.intrinsics, group.photos, options.min_seed_angle_deg)
    seeds = seeds[: options.max_init_pairs] if options.mapper != "global" or not at_once else []
    if at_once:
        copy_database(run.workspace.database, run.workspace.root / GLOBAL_FOLDER)
    with _attempt_runner(group, run) as made:
        found = made(lambda token: _run_first_round(group, seeds[:1], at_once, run, is_settled, token))
        for seed in seeds[1:]:
            if _can_stop(found, len(group.photos)):
                break
            found += made(partial(_attempt_from_seed, group, seed, run))
        best = best_attempt(found)
        if best is not None and best.mapper == "global" and best.photos < len(group.photos):
            found += made(partial(_attempt_completion, group, best, run))
    return found


def complete_attempt(group: Group, attempt: Attempt, run: RunContext) -> list[MappingResult]:
    """Continue a model photo by photo, with the photos that it lacks.

    Args:
        group: a connected group of photos, with their matches and poses.
        attempt: its model so far.
        run: the run.
    """
    with _attempt_runner(group, run) as made:
        return made(partial(_attempt_completion, group, attempt, run))


def best_attempt(found: Sequence[MappingResult]) -> Attempt | None:
    """Return the attempt with the largest support; among equal ones, the one with most photos and points."""
    models = [attempt for attempt in found if isinstance(attempt, Attempt)]
    most = max((attempt.support for attempt in models), default=0.0)
    equal = [attempt for attempt in models if attempt.support >= (1.0 - EQUAL_TOLERANCE) * most]
    return max(equal, key=lambda attempt: (attempt.photos, attempt.model.num_points3D()), default=None)


def choice_reason(best: Attempt, found: Sequence[MappingResult], photos: int) -> str:
    """Return why an attempt was chosen among several, in a few words.

    Args:
        best: the chosen attempt.
        found: all attempts.
        photos: number of photos in the group.
    """
    if _is_flawless(best, photos):
        return f"it places all {photos} photos and next to nothing contradicts it"
    others = [attempt for attempt in found if isinstance(attempt, Attempt) and attempt is not best]
    if len(found) == 1:
        return "it explains enough to need no other way"
    if not others:
        return "nothing else gave a model"
    rival = max(others, key=lambda attempt: attempt.support)
    counts = [sum(pair.matches for pair in attempt.explained.values()) for attempt in (best, rival)]
    return f"it explains {counts[0]} matches with {best.photos} photos, the next best {counts[1]} with {rival.photos}"


def _is_flawless(attempt: Attempt, photos: int) -> bool:
    """Return whether a model holds all photos, and hardly any inliers contradict it."""
    inliers = sum(pair.inliers for pair in attempt.explained.values())
    against = sum(pair.contradicted for pair in attempt.explained.values())
    return attempt.photos == photos and against <= MAX_CONTRADICTED_SHARE * inliers


@contextlib.contextmanager
def _attempt_runner(group: Group, run: RunContext) -> Iterator[Callable[[Maker], list[MappingResult]]]:
    """Provide a function that makes attempts in a thread that Ctrl-C can stop."""

    def run_maker(make: Maker) -> list[MappingResult]:
        found: list[MappingResult] = []
        run.progress.start("mapping", max(len(group.photos) - 2, 1))
        try:
            run_interruptible(lambda token: found.extend(make(token)), lambda: None)
        finally:
            run.progress.finish()
        return found

    with translate_errors("mapping photos"):
        yield run_maker


def _run_first_round(
    group: Group, seeds: Sequence[Candidate], at_once: bool, run: RunContext, is_settled: Callable[[Attempt], bool],
    token: CancellationToken,
) -> list[MappingResult]:  # fmt: skip
    stop = StopSignal(token)

    def map_from_seed(seed: Candidate) -> MappingResult:
        (attempt,) = _attempt_from_seed(group, seed, run, token)
        stop.needless = isinstance(attempt, Attempt) and (
            _is_flawless(attempt, len(group.photos)) or is_settled(attempt)
        )
        return attempt

    at_a_time = 1 if seeds and _is_easy(group) else min(run.workers, 2)
    with ThreadPoolExecutor(at_a_time, thread_name_prefix="mapper") as pool:
        grown = [pool.submit(map_from_seed, seed) for seed in seeds]
        placed = [pool.submit(_attempt_globally, group, run, stop)] if at_once else []
        found = [future.result() for future in (*grown, *placed)]
    if stop.needless:
        found[1:] = [NoModel("global", "all at once: not needed") for _ in placed]
    return found


def _is_easy(group: Group) -> bool:
    """Return whether cameras are well known, and hardly any pair contradicts the others."""
    inside = set(group.photos)
    kept = sum(inside.issuperset(pair) for pair in group.graph.poses)
    dropped = sum(inside.issuperset(pair) for pair in group.graph.dropped)
    known = all(is_well_known(group.intrinsics.camera(group.matches.images[photo])) for photo in group.photos)
    return known and dropped <= MOST_DROPPED * (kept + dropped)


def _can_stop(found: Sequence[MappingResult], photos: int) -> bool:
    """Return whether another seed is unlikely to place more photos."""
    counts = [attempt.photos for attempt in found if isinstance(attempt, Attempt)]
    most = max(counts, default=0)
    return most >= ENOUGH_SHARE * photos or (counts.count(most) > 1 and most >= CONFIRMED_SHARE * photos)


def _attempt_globally(group: Group, run: RunContext, stop: StopSignal) -> MappingResult:
    names, scratch = photo_names(group.photos, group.matches), run.workspace.root / GLOBAL_FOLDER
    try:
        model = None if stop.is_cancelled else map_globally(run.workspace.photos, names, scratch, run.seed, stop)
    except BackendError as err:  # another mapper may do better
        logger.info("the global mapper failed: %s", err)
        return NoModel("global", f"all at once: failed, {err}")
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return _judge_model(group, "global", "all at once", model, run)


def _attempt_from_seed(group: Group, seed: Candidate, run: RunContext, token: CancellationToken) -> list[MappingResult]:
    how = f"from {' + '.join(photo_names(seed.pair, group.matches))}"
    rows = group.matches.matches[seed.pair][seed.pose.inliers]
    try:
        points = triangulate_seed(group.matches, seed, group.intrinsics)
    except FAILURES as err:
        return [NoModel("incremental", f"{how}: no points, {error_reason(err)}")]
    start = model_from_seed(run.workspace.database, seed.pair, rows, points)
    return [_judge_model(group, "incremental", how, _grow(group, start, run, token), run)]


def _attempt_completion(group: Group, best: Attempt, run: RunContext, token: CancellationToken) -> list[MappingResult]:
    """Continue the global mapper's model photo by photo, with the photos that it left out."""
    model = _grow(group, best.model, run, token)
    return [_judge_model(group, "incremental", "what was left out, photo by photo", model, run)]


def _grow(group: Group, start: Reconstruction, run: RunContext, token: CancellationToken) -> Reconstruction | None:
    place, cameras = run.workspace, {k: group.intrinsics.camera(group.matches.images[k]) for k in group.photos}
    kept = {start.images[k].camera_id for k, camera in cameras.items() if camera.is_kept and start.exists_image(k)}
    return map_incrementally(
        place.database, place.photos, start, place.root / INCREMENTAL_FOLDER,
        incremental_options(run.seed, known=all(map(is_well_known, cameras.values())), kept=kept),
        run.progress.advance, token,
    )  # fmt: skip


def is_well_known(camera: Calibration) -> bool:
    """Return whether a focal is known so well that the first few photos of a mapping cannot improve it."""
    spread = 0.0 if camera.is_kept else camera.spread.get("fx", np.inf)
    return camera.identifiable and spread <= MAX_FOCAL_DEVIATION * camera.K[0, 0]


def judge_model(
    matches: MatchGraph, views: ViewGraph, made: tuple[str, str], model: Reconstruction | None, run: RunContext
) -> MappingResult:
    """Count the matches that a model explains.

    Args:
        matches: keypoints and raw matches.
        views: fundamental matrices.
        made: name of the mapper, and how it was used.
        model: COLMAP's reconstruction, if there is one.
        run: the run.
    """
    mapper, how = made
    placed = model.num_reg_images() if model is not None else 0
    note = f"{how}: {placed} photos"
    if model is None or placed < 2 or model.num_points3D() < run.settings.scene.min_points:
        return NoModel(mapper, note)
    try:
        explained = explained_pairs(model, matches, views, run.settings.epipolar.max_error_px)
    except FAILURES as err:
        logger.info("a model could not be judged", exc_info=err)
        return NoModel(mapper, f"{note}, that could not be judged: {error_reason(err)}")
    return Attempt(mapper, model, explained, note)


def _judge_model(group: Group, mapper: str, how: str, model: Reconstruction | None, run: RunContext) -> MappingResult:
    return judge_model(group.matches, group.views, (mapper, how), model, run)
