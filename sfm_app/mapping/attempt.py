"""One attempt to map a group: pairs to start from, COLMAP's mappers, and how well a model explains its matches."""

import logging
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, TypeAlias

import numpy as np

from sfm_app.camera.bearings import bearings
from sfm_app.colmap.backend import CancellationToken, Reconstruction, run_interruptible, translate_errors
from sfm_app.colmap.mapping import copy_database, incremental_options, map_globally, map_incrementally
from sfm_app.colmap.model import model_from_seed, placed_views
from sfm_app.errors import BackendError
from sfm_app.geometry.epipolar import GOOD_ANGLE_DEG, TwoViewSeed, cross_matrix, ray_seed, two_view_seed
from sfm_app.geometry.poses import explained_mask, ray_angles_deg
from sfm_app.numerical import FAILURES, error_reason
from sfm_app.retrieval import choose_by_rank
from sfm_app.runtime.context import RunContext
from sfm_app.types import Calibration, Evidence, MatchGraph, PairId, PoseGraph, RelativePose, ViewGraph
from sfm_app.types.arrays import FloatArray
from sfm_app.types.camera import PERSPECTIVE

logger = logging.getLogger("sfm_app")

INCREMENTAL_FOLDER, GLOBAL_FOLDER = "incremental", "global"
COMPLETED = "missing photos added one by one"
"""Note of a model that another mapper began."""
NOT_NEEDED = "all at once: not needed"
"""Note of a global mapper that was stopped."""


class MAPPING:
    """When mapping starts, ends, and counts as good."""

    dissent_weight: float = 0.1
    """Weight of a seed that contradicts the camera matrix of the other pairs. Chosen by hand."""
    planar_weight: float = 0.5
    """Weight of a seed on a plane or of a forward motion: its pose is less certain. Chosen by hand."""
    forward: float = 0.95
    """Share of the translation along the axis of the camera that makes a motion forward. Chosen by hand."""
    grid: int = 8
    """Cells across and down a photo for the coverage of a seed. Chosen by hand."""
    loose_factor: float = 2.0
    """Largest error of an explained match, in inlier thresholds. Chosen by hand."""
    saturation: float = 100.0
    """Number of matches at which the support of a pair reaches half of its limit. Chosen by hand."""
    many_photos: int = 60
    """Size of a set from which few unregistered photos do not justify another mapping. Chosen by hand."""
    few_lost: float = 0.05
    """Share of unregistered photos that is few there. Chosen by hand."""
    enough_share: float = 0.9
    """Share of the photos of a group that counts as most, and ends the search for a better seed. Chosen by hand."""
    confirmed_share: float = 0.5
    """The same when the two largest models, of any mapper, place equally many photos. Chosen by hand."""
    min_photos: int = 3
    """Least photos for learning a camera, for further groups, and for a scale in the global mapper."""
    equal_tolerance: float = 0.01
    """Relative difference of supports below which models count as equal. Chosen by hand."""
    max_contradicted_share: float = 0.1
    """Share of the inliers of F that may contradict a right model whose cameras were known: of fox50, 7 %, because
    mapping does not estimate its lens. Measured."""
    guessed_contradicted_share: float = 0.01
    """The same where a camera was a guess, which mapping estimates as well. Chosen by hand."""
    max_focal_deviation: float = 0.01
    """Relative standard deviation of a focal up to which mapping holds it fixed. Chosen by hand."""
    fully_mapped_photos: int = 250
    """Photos up to which mapping uses all pairs. Chosen by hand."""
    mapped_partners: int = 16
    """Partners of each photo above. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pair of photos that mapping may start from."""

    pair: PairId
    pose: RelativePose
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """A connected group of photos, the evidence about them, and their relative poses."""

    photos: Sequence[int]
    evidence: Evidence
    graph: PoseGraph


def rank_seeds(group: Group, min_angle_deg: float) -> list[Candidate]:
    """Return candidates for the first pair, best first: many spread points, wide angles, consistent with K."""
    members, candidates = set(group.photos), []
    for pair, pose in group.graph.poses.items():
        if members.issuperset(pair) and pose.kind != "rotation" and pose.angle_deg >= min_angle_deg:
            cameras = [group.evidence.camera(photo) for photo in pair]
            weight = coverage(group.evidence.matches, pair, pose) * agreement(pair, cameras)
            weight *= MAPPING.planar_weight if pose.kind == "planar" or abs(pose.t[2]) > MAPPING.forward else 1.0
            score = pose.inlier_count * min(pose.angle_deg / GOOD_ANGLE_DEG, 1.0) * pose.in_front**4 * weight
            candidates.append(Candidate(pair, pose, score))
    return sorted(candidates, key=lambda candidate: (-candidate.score, candidate.pair))


def triangulate_seed(candidate: Candidate, evidence: Evidence) -> TwoViewSeed:
    """Return the pose and triangulated points of a candidate."""
    pose, cameras = candidate.pose, [evidence.camera(photo) for photo in candidate.pair]
    points = evidence.matches.points(candidate.pair)
    lines = [bearings(x[pose.inliers], camera) for x, camera in zip(points, cameras, strict=True)]
    if any(camera.projection != PERSPECTIVE for camera in cameras):
        return ray_seed(pose.R, pose.t, np.hstack(lines))
    x1, x2 = (one[:, :2] for one in lines)
    return two_view_seed(cross_matrix(pose.t) @ pose.R, x1, x2)


def agreement(pair: PairId, cameras: Sequence[Calibration]) -> float:
    """Return the weight of a pair: 1 unless it contradicts the camera that other pairs agree on."""
    first, second = cameras
    unknown = first is not second or not first.key_pairs
    return 1.0 if unknown or pair in first.key_pairs else MAPPING.dissent_weight


def coverage(matches: MatchGraph, pair: PairId, pose: RelativePose) -> float:
    """Return the share of cells with an inlier, of those that the inliers could fill; geometric mean of both photos."""
    shares = []
    for photo, x in zip(pair, matches.points(pair), strict=True):
        image = matches.images[photo]
        cells = (x[pose.inliers] / [image.width, image.height] * MAPPING.grid).astype(int).clip(0, MAPPING.grid - 1)
        filled = len(np.unique(cells[:, 0] * MAPPING.grid + cells[:, 1]))
        shares.append(filled / min(MAPPING.grid * MAPPING.grid, max(pose.inlier_count, 1)))
    return float(np.sqrt(shares[0] * shares[1]))


# Support of a model: raw matches on its epipolar lines, in front of both cameras. Unlike points, tracks and
# reprojection errors, this count does not depend on the mapper.


@dataclass(frozen=True, slots=True)
class PairSupport:
    """Numbers of matches of a pair that a model explains or contradicts."""

    matches: int
    """Raw matches that the model explains."""
    inliers: int
    """Inliers of the fundamental matrix of the pair."""
    contradicted: int
    """Inliers that the model does not explain."""


def explained_pairs(model: Reconstruction, evidence: Evidence, max_error_px: float) -> dict[PairId, PairSupport]:
    """Return how well a model explains every pair of its photos."""
    explained = {}
    for pair, posed in _posed_pairs(model, evidence.matches):
        fits_model = explained_mask(*posed, MAPPING.loose_factor * max_error_px)
        fit = evidence.views.fits.get(pair)
        contradicted = int(np.count_nonzero(fit.inliers & ~fits_model)) if fit else 0
        explained[pair] = PairSupport(int(np.count_nonzero(fits_model)), fit.inlier_count if fit else 0, contradicted)
    return explained


def model_poses(
    model: Reconstruction, matches: MatchGraph, max_error_px: float, least: int
) -> dict[PairId, RelativePose]:
    """Return the relative poses of a model for the pairs of its photos with at least `least` explained matches."""
    poses = {}
    for pair, (lines, R, t) in _posed_pairs(model, matches):
        inliers = explained_mask(lines, R, t, max_error_px)
        if np.count_nonzero(inliers) >= least:
            angle_deg = float(np.median(ray_angles_deg(lines[inliers], R)))
            poses[pair] = RelativePose(R, t, inliers, angle_deg=angle_deg, in_front=1.0, kind="calibrated")
    return poses


def _posed_pairs(
    model: Reconstruction, matches: MatchGraph
) -> Iterator[tuple[PairId, tuple[FloatArray, FloatArray, FloatArray]]]:
    """Yield the matches (M, 18) of pairs as bearing vectors, with R and t of view 2 from view 1.

    t has length 1, or is 0 for equal positions.
    """
    placed = placed_views(model, matches.keypoints)
    for pair, rows in matches.matches.items():
        if pair[0] not in placed or pair[1] not in placed:
            continue
        first, second = placed[pair[0]], placed[pair[1]]
        R = second.R @ first.R.T
        t = second.t - R @ first.t
        lines = np.hstack([first.lines[rows[:, 0]], second.lines[rows[:, 1]]])
        yield pair, (lines, R, t / max(float(np.linalg.norm(t)), 1e-300))


def support(explained: Mapping[PairId, PairSupport]) -> float:
    """Return the score of a model: matches that it explains, less those that it contradicts, saturated by pair."""
    pairs = explained.values()
    return float(np.sum(saturate([pair.matches for pair in pairs]) - saturate([pair.contradicted for pair in pairs])))


def saturate(matches: Sequence[int]) -> FloatArray:
    """Return the weight (N,) of the matches of each pair in a score: each further match counts less."""
    counts = np.array(matches, np.float64)
    return np.asarray(counts / (1.0 + counts / MAPPING.saturation))


def are_many_unregistered(lost: int, photos: int) -> bool:
    """Return whether unregistered photos justify another mapping of all photos."""
    return lost > 0 and (photos < MAPPING.many_photos or lost >= MAPPING.few_lost * photos)


def unregistered_reasons(
    posed: set[int], others: Sequence[Sequence[int]], matches: MatchGraph, views: ViewGraph, graph: PoseGraph
) -> dict[str, str]:
    """Return why each photo is missing in the main model, by name; `others` are the photos of the other models."""
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
    edges = {pair[pair[0] == photo]: fit.inlier_count for pair, fit in views.fits.items() if photo in pair}
    to_posed = {other: count for other, count in edges.items() if other in posed}
    if to_posed:
        nearest = max(to_posed, key=lambda other: (to_posed[other], -other))
        contradiction = graph.dropped.get((min(photo, nearest), max(photo, nearest)))
        because = f", but that pair was dropped: {contradiction}" if contradiction else ""
        return f"could not be placed: {to_posed[nearest]} inliers with the nearest placed photo{because}"
    return (
        "shares inliers only with photos that have no place either" if edges else "shares no scene with any other photo"
    )


# COLMAP's two mappers on one group of photos, side by side, and the choice of the better model.


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """A model that a mapper made of a group, and the matches that it explains."""

    mapper: str
    model: Reconstruction
    explained: dict[PairId, PairSupport]
    note: str
    """How it was made, and how many photos it holds; for people."""
    reason: str = ""
    """Why this mapper followed another one; empty for the first."""
    seconds: float = 0.0
    """Time of a mapper that followed another one."""

    @property
    def photos(self) -> int:
        """Number of posed photos."""
        return self.model.num_reg_images()

    @property
    def support(self) -> float:
        """Score of the model, see `support`."""
        return support(self.explained)

    @property
    def contradicted_share(self) -> float:
        """Share of the inliers of F that contradict the model, 0 to 1."""
        pairs = self.explained.values()
        return sum(pair.contradicted for pair in pairs) / max(sum(pair.inliers for pair in pairs), 1)


@dataclass(frozen=True, slots=True)
class NoModel:
    """Why a mapper gave no model, or one with too few points; the fields are those of `Attempt`."""

    mapper: str = ""
    note: str = ""
    reason: str = ""
    seconds: float = 0.0
    photos: ClassVar[int] = 0
    support: ClassVar[float] = 0.0


MappingResult: TypeAlias = Attempt | NoModel
"""Result of a mapper."""


def pairs_to_map(graph: PoseGraph) -> PoseGraph:
    """Return the pose graph with as many pairs as mapping needs: COLMAP follows all pairs of every point repeatedly."""
    photos = {photo for pair in graph.poses for photo in pair}
    if len(photos) <= MAPPING.fully_mapped_photos:
        return graph
    counts = {pair: pose.inlier_count for pair, pose in graph.poses.items()}
    chosen = choose_by_rank(counts, 0, MAPPING.mapped_partners)
    return replace(graph, poses={pair: pose for pair, pose in graph.poses.items() if pair in chosen})


@dataclass(frozen=True, slots=True)
class ColmapMappers:
    """COLMAP's mappers and the score of their models; tests pass others."""

    copy_database: Callable[..., object] = copy_database
    model_from_seed: Callable[..., Reconstruction] = model_from_seed
    map_incrementally: Callable[..., Reconstruction | None] = map_incrementally
    map_globally: Callable[..., Reconstruction | None] = map_globally
    explained_pairs: Callable[..., dict[PairId, PairSupport]] = explained_pairs


COLMAP = ColmapMappers()


def map_group(
    group: Group,
    run: RunContext,
    is_sufficient: Callable[[Attempt], bool] = lambda _: False,
    colmap: ColmapMappers = COLMAP,
) -> list[MappingResult]:
    """Return the results of the mappers on a group.

    The incremental mapper begins with the best seed. Where its model is doubtful, the global mapper follows; where
    neither places most photos, the next seeds follow. `is_sufficient` accepts a doubtful incremental model.
    """
    options, mapper, photos = run.settings.scene, _GroupMapper(group, run, colmap), len(group.photos)
    with_global = options.mapper != "incremental" and options.tries("global-mapper") and photos >= MAPPING.min_photos
    seeds = rank_seeds(group, options.min_seed_angle_deg)
    seeds = seeds[: options.max_init_pairs] if options.mapper != "global" or not with_global else []
    with translate_errors("mapping photos"):
        results = [mapper.from_seed(seed) for seed in seeds[:1]]
        if with_global:
            first, reason = best_attempt(results), "no photo is registered"
            if first is not None:
                reason = "" if is_sufficient(first) else doubt(first, photos, group.evidence)
            results.append(mapper.all_at_once(reason) if reason else NoModel("global", NOT_NEEDED))
        for seed in seeds[1:]:
            if _has_placed_enough(results, photos):
                break
            results.append(mapper.from_seed(seed))
        best = best_attempt(results)
        if best is not None and best.mapper == "global" and best.photos < photos:
            results.append(mapper.judge("incremental", COMPLETED, mapper.extend(best.model)))
    return results


def extend_model(group: Group, start: Reconstruction, run: RunContext) -> Reconstruction | None:
    """Continue a model photo by photo, with the missing photos of its group."""
    with translate_errors("mapping photos"):
        return _GroupMapper(group, run, COLMAP).extend(start)


class _GroupMapper:
    def __init__(self, group: Group, run: RunContext, colmap: ColmapMappers) -> None:
        self.group, self.run, self.colmap = group, run, colmap

    def all_at_once(self, reason: str) -> MappingResult:
        start = time.monotonic()
        names, scratch = self.group.evidence.matches.names(self.group.photos), self.run.workspace.root / GLOBAL_FOLDER
        photos, seed = self.run.workspace.photos, self.run.seed
        self.colmap.copy_database(self.run.workspace.database, scratch)
        try:
            model = self._map(lambda token: self.colmap.map_globally(photos, names, scratch, seed, token))
        except BackendError as err:  # another mapper may do better
            logger.info("the global mapper failed: %s", err)
            return NoModel("global", f"all at once: failed, {err}", reason, time.monotonic() - start)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
        result = self.judge("global", "all at once", model)
        return replace(result, reason=reason, seconds=time.monotonic() - start)

    def from_seed(self, seed: Candidate) -> MappingResult:
        evidence = self.group.evidence
        how = f"from {' + '.join(evidence.matches.names(seed.pair))}"
        rows = evidence.matches.matches[seed.pair][seed.pose.inliers]
        try:
            points = triangulate_seed(seed, evidence)
        except FAILURES as err:
            return NoModel("incremental", f"{how}: no points, {error_reason(err)}")
        start = self.colmap.model_from_seed(self.run.workspace.database, seed.pair, rows, points)
        return self.judge("incremental", how, self.extend(start))

    def extend(self, start: Reconstruction) -> Reconstruction | None:
        return self._map(partial(self._grow, start))

    def _map(self, make: Callable[[CancellationToken], Reconstruction | None]) -> Reconstruction | None:
        self.run.progress.start("mapping", max(len(self.group.photos) - 2, 1))
        try:
            return run_interruptible(make)
        finally:
            self.run.progress.finish()

    def _grow(self, start: Reconstruction, token: CancellationToken) -> Reconstruction | None:
        run, place = self.run, self.run.workspace
        cameras = {k: self.group.evidence.camera(k) for k in self.group.photos}
        kept = {start.images[k].camera_id for k, camera in cameras.items() if camera.is_kept and start.exists_image(k)}
        options = incremental_options(run.seed, known=all(map(is_focal_accurate, cameras.values())), kept=kept)
        scratch = place.root / INCREMENTAL_FOLDER
        return self.colmap.map_incrementally(
            place.database, place.photos, start, scratch, options, run.progress.advance, token
        )

    def judge(self, mapper: str, how: str, model: Reconstruction | None) -> MappingResult:
        return judge_model(self.group.evidence, mapper, how, model, self.run, self.colmap.explained_pairs)


def best_attempt(results: Sequence[MappingResult]) -> Attempt | None:
    """Return the attempt with the largest support; among equal ones, the one with most photos and points."""
    models = [attempt for attempt in results if isinstance(attempt, Attempt)]
    most = max((attempt.support for attempt in models), default=0.0)
    equal = [attempt for attempt in models if attempt.support >= (1.0 - MAPPING.equal_tolerance) * most]
    return max(equal, key=lambda attempt: (attempt.photos, attempt.model.num_points3D()), default=None)


def choice_reason(best: Attempt, results: Sequence[MappingResult]) -> str:
    """Return why an attempt was chosen among several."""
    if len(results) == 1 or any(result.note == NOT_NEEDED for result in results):
        return f"it explains enough: {100 * best.contradicted_share:.1f} % of the matches contradict it"
    others = [attempt for attempt in results if isinstance(attempt, Attempt) and attempt is not best]
    if not others:
        return "no other attempt gave a model"
    rival = max(others, key=lambda attempt: attempt.support)
    counts = [sum(pair.matches for pair in attempt.explained.values()) for attempt in (best, rival)]
    return f"it explains {counts[0]} matches with {best.photos} photos, the second best {counts[1]} with {rival.photos}"


def doubt(model: Attempt, photos: int, evidence: Evidence) -> str:
    """Return why another mapper may find a better model of this many photos; empty where the evidence is good."""
    if are_many_unregistered(photos - model.photos, photos):
        return f"unregistered photos with matches: {photos - model.photos}"
    known = all(evidence.camera(photo).is_estimated for photo in evidence.matches.images)
    limit = MAPPING.max_contradicted_share if known else MAPPING.guessed_contradicted_share
    share = model.contradicted_share
    return f"{100 * share:.0f} % of the matches contradict the model" if share > limit else ""


def _has_placed_enough(results: Sequence[MappingResult], photos: int) -> bool:
    counts = [attempt.photos for attempt in results if isinstance(attempt, Attempt)]
    largest = max(counts, default=0)
    return largest >= MAPPING.enough_share * photos or (
        counts.count(largest) > 1 and largest >= MAPPING.confirmed_share * photos
    )


def is_focal_accurate(camera: Calibration) -> bool:
    """Return whether a focal is known so well that the first photos of a mapping cannot improve it."""
    spread = 0.0 if camera.is_kept else camera.spread.get("fx", np.inf)
    return camera.identifiable and spread <= MAPPING.max_focal_deviation * camera.K[0, 0]


def judge_model(
    evidence: Evidence,
    mapper: str,
    how: str,
    model: Reconstruction | None,
    run: RunContext,
    explain: Callable[..., dict[PairId, PairSupport]] = explained_pairs,
) -> MappingResult:
    """Count the matches that a model explains."""
    placed = model.num_reg_images() if model is not None else 0
    note = f"{how}: {placed} photos"
    if model is None or placed < 2 or model.num_points3D() < run.settings.scene.min_points:
        return NoModel(mapper, note)
    try:
        explained = explain(model, evidence, run.settings.epipolar.max_error_px)
    except FAILURES as err:
        logger.info("a model could not be judged", exc_info=err)
        return NoModel(mapper, f"{note}, but it could not be scored: {error_reason(err)}")
    return Attempt(mapper, model, explained, note)
