"""One pass over all photos: relative poses, COLMAP's mappers on every connected group, and the models of the groups.

A rival is mapped by COLMAP's default pipeline with the usual guess of the camera. It uses none of our fundamental
matrices, cameras and poses, and so shares none of their errors.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import chain
from typing import NamedTuple

from sfm_app.camera.models import GUESSED_FOCAL, guessed_camera_matrix
from sfm_app.colmap.backend import Reconstruction, run_interruptible, translate_errors
from sfm_app.colmap.bundle import find_cameras
from sfm_app.colmap.database import keep_raw_matches, write_calibrations, write_pose_graph
from sfm_app.colmap.mapping import copy_database, map_with_colmap_defaults
from sfm_app.colmap.model import posed_photo_ids
from sfm_app.errors import BackendError
from sfm_app.mapping.attempt import (
    MAPPING,
    Attempt,
    Group,
    MappingResult,
    NoModel,
    best_attempt,
    choice_reason,
    judge_model,
    map_group,
    model_poses,
    pairs_to_map,
)
from sfm_app.mapping.look_alikes import (
    OVERLAPS,
    find_misplaced,
    joined_pairs,
    judge_places,
    with_earlier_look_alikes,
    with_false_joins,
)
from sfm_app.mapping.parts import map_in_parts, part_size, parts_suffice
from sfm_app.mapping.splits import part_of, split_attempt
from sfm_app.numerical import Json
from sfm_app.posegraph import PoseGraphOptions, build_pose_graph, with_model
from sfm_app.runtime.context import RunContext
from sfm_app.settings import FIRST_TRIAL, SceneSettings
from sfm_app.types import Calibration, Evidence, Intrinsics, LookAlikes, PoseGraph
from sfm_app.types.camera import PERSPECTIVE

logger = logging.getLogger("sfm_app")


CONTRADICTED_JOIN = "more matches contradict a join than support it"


@dataclass(frozen=True, slots=True)
class Trial:
    """A hypothesis that was tried, and what it gained."""

    name: str
    """Of the hypothesis; "outer: inner" within another one."""
    reason: str
    """Why it was tried; for people."""
    accepted: bool
    photos: tuple[int, int]
    """Photos of the main model before and with it."""
    support: tuple[float, float]
    """Support of the main model before and with it."""
    seconds: float
    notes: tuple[str, ...] = ()
    """How its models were made; for people."""
    failure: str = ""
    """Why it failed, for people; empty if it did not."""

    @classmethod
    def of(
        cls, name: str, reason: str, before: "MappingResult | Outcome", after: "MappingResult | Outcome", *,
        accepted: bool, seconds: float = 0.0, notes: tuple[str, ...] = (),
    ) -> "Trial":  # fmt: skip
        """Compare the results before and with a hypothesis."""
        photos, supports = (before.photos, after.photos), (before.support, after.support)
        return cls(name, reason, accepted, photos, supports, seconds, notes)

    @property
    def is_hypothesis(self) -> bool:
        """Whether this is neither the first pass nor a part of another trial."""
        return self.name != FIRST_TRIAL and ":" not in self.name

    def to_dict(self) -> dict[str, Json]:
        """Return JSON values."""
        return asdict(self) | {"support": [round(one, 1) for one in self.support], "seconds": round(self.seconds, 1)}


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Models of all groups of photos, before the last adjustment."""

    models: tuple[Attempt, ...]
    """The main model first."""
    graph: PoseGraph
    evidence: Evidence
    """All matches, with the cameras that the models were mapped with."""
    calibrated: Intrinsics
    """Cameras before mapping."""
    run: RunContext
    """Run whose database holds these matches."""
    notes: tuple[str, ...] = ()
    """How the models of its pass were made, those that lost included; for people."""
    reason: str = ""
    """Why the attempt behind the main model was chosen."""
    cuts: tuple[str, ...] = ()
    """Names of the photos of each part of a model that was cut because matches contradict the join."""
    trials: tuple[Trial, ...] = ()
    """Hypotheses that were tried."""

    @property
    def main(self) -> Attempt | None:
        """The main model, if there is one."""
        return self.models[0] if self.models else None

    @property
    def photos(self) -> int:
        """Photos of the main model; 0 without one."""
        return self.models[0].photos if self.models else 0

    @property
    def support(self) -> float:
        """Support of the main model; 0 without one."""
        return self.models[0].support if self.models else 0.0

    @property
    def cameras(self) -> int:
        """Number of cameras of the main model; 0 without one."""
        return len(set(map(self.evidence.camera_name, posed_photo_ids(self.models[0].model)))) if self.models else 0

    @property
    def trusted(self) -> Evidence:
        """The evidence without look-alikes."""
        return self.evidence.without(joined_pairs(self.graph.look_alikes))

    def with_earlier(self, earlier: "Outcome") -> "Outcome":
        """Add the matches and look-alikes of an earlier outcome, from whose trusted evidence this one was mapped."""
        evidence = replace(earlier.evidence, intrinsics=self.evidence.intrinsics)
        graph = with_earlier_look_alikes(self.graph, earlier.graph)
        return replace(self, evidence=evidence, calibrated=earlier.calibrated, graph=graph)


class MappedGroup(NamedTuple):
    """Results of the mappers on a group, the best of them, and its parts."""

    results: Sequence[MappingResult]
    best: Attempt | None
    parts: Sequence[Attempt]

    def trials(self) -> Iterator[Trial]:
        """Yield the hypotheses of a pass that were tried: the global mapper, and a split of the best model."""
        for number, one in enumerate(self.results):
            if one.reason:
                first, own, notes = best_attempt(self.results[:number]) or NoModel(), one is self.best, (one.note,)
                yield Trial.of("global-mapper", one.reason, first, one, accepted=own, seconds=one.seconds, notes=notes)
        if self.best is not None and len(self.parts) > 1:
            yield Trial.of("splits", CONTRADICTED_JOIN, self.best, self.parts[0], accepted=True)


def _outcome_of(groups: Sequence[MappedGroup], start: Outcome) -> Outcome:
    models = sorted(chain(*(group.parts for group in groups)), key=lambda one: (-one.photos, -one.support))
    cut = [part for group in groups if len(group.parts) > 1 for part in group.parts]
    names = start.evidence.matches.names
    reasons = [choice_reason(best, results) for results, best, parts in groups if best and parts and models[0] in parts]
    return replace(
        start,
        models=tuple(models),
        notes=tuple(result.note for group in groups for result in group.results),
        reason="".join(reasons),
        cuts=tuple(", ".join(names(sorted(posed_photo_ids(part.model)))) for part in cut),
        trials=tuple(chain(*(group.trials() for group in groups))),
    )


MISPLACED = (
    "where its matches place it, most of the expected points are missing; perhaps it shows another, equal side: take "
    "photos between the two sides"
)
"""Why a photo was left out."""


def without_misplaced(outcome: Outcome, adjusted: Sequence[Reconstruction]) -> Outcome:
    """Leave out photos that are misplaced in the adjusted models, and the pairs that put them there.

    Return the same outcome where there are none. Most photos define the model, and stay in it.
    """
    if not outcome.run.settings.scene.tries("look-alikes"):
        return outcome
    max_error_px = MAPPING.loose_factor * outcome.run.settings.epipolar.max_error_px
    models, joins = list(outcome.models), list[LookAlikes]()
    for number, (attempt, model) in enumerate(zip(outcome.models, adjusted, strict=True)):
        misplaced = find_misplaced(model, outcome.evidence, max_error_px)
        if not 0 < len(misplaced) < attempt.photos / 2:
            continue
        with translate_errors("leaving out photos"):
            models[number] = part_of(attempt, set(posed_photo_ids(attempt.model)) - misplaced.keys())
        for photo, missing in misplaced.items():
            pairs = {
                pair for pair, one in attempt.explained.items() if photo in pair and one.matches > one.contradicted
            }
            joins.append(LookAlikes(tuple(sorted(pairs & outcome.graph.poses.keys())), missing))
    if not joins:
        return outcome
    graph = with_false_joins(outcome.graph, [join for join in joins if join.pairs])
    return replace(outcome, models=tuple(models), graph=graph)


RIVAL, RIVAL_FOLDER, RIVAL_NOTE = "colmap", "rival", "COLMAP's default pipeline"


def map_rival(evidence: Evidence, run: RunContext) -> Attempt | NoModel:
    """Map the same matches with COLMAP's default pipeline and stated focals, and score the model like any other."""
    scratch = run.workspace.root / RIVAL_FOLDER
    try:
        with translate_errors("mapping photos with COLMAP's defaults"):
            copy_database(run.workspace.database, scratch)
            write_calibrations(scratch / "database.db", evidence.matches, guessed_intrinsics(evidence.intrinsics))
            keep_raw_matches(scratch / "database.db", evidence.matches.matches)
            model = run_interruptible(
                lambda token: map_with_colmap_defaults(run.workspace.photos, scratch, run.seed, token)
            )
    except BackendError as err:  # our own model is not lost with it
        logger.info("the rival failed: %s", err)
        return NoModel(RIVAL, f"{RIVAL_NOTE}: failed, {err}")
    return judge_model(evidence, RIVAL, RIVAL_NOTE, model, run)


def guessed_intrinsics(intrinsics: Intrinsics, sides: float = GUESSED_FOCAL) -> Intrinsics:
    """Replace every perspective camera without a stated focal by a guess of `sides` longer sides."""
    cameras = {
        name: guess_again(camera, sides * max(camera.width, camera.height), camera.reason)
        if camera.projection == PERSPECTIVE and not (camera.is_claimed or camera.is_given)
        else camera
        for name, camera in intrinsics.cameras.items()
    }
    return replace(intrinsics, cameras=cameras)


def guess_again(camera: Calibration, focal_px: float, reason: str) -> Calibration:
    """Return a guess with another focal, for a reason that people read."""
    size = camera.width, camera.height
    return Calibration(guessed_camera_matrix(size, focal_px), *size, "guess", identifiable=False, reason=reason)


@dataclass(frozen=True, slots=True)
class Mappers:
    """Functions that map a group and judge its model; tests pass others."""

    part_size: Callable[[int, SceneSettings], int] = part_size
    map_group: Callable[[Group, RunContext], list[MappingResult]] = map_group
    map_in_parts: Callable[..., tuple[list[MappingResult], tuple[LookAlikes, ...]]] = map_in_parts
    map_rival: Callable[[Evidence, RunContext], Attempt | NoModel] = map_rival
    judge_places: Callable[[Sequence[Attempt]], tuple[list[LookAlikes], int]] = judge_places
    find_cameras: Callable[[Reconstruction], dict[int, int]] = find_cameras


MAPPERS = Mappers()


class Mapper:
    """Maps evidence. The database of the run holds the matches, and the relative poses of one outcome."""

    def __init__(self, run: RunContext, mappers: Mappers = MAPPERS) -> None:
        self.run, self.mappers = run, mappers
        self.judge_places = cache(mappers.judge_places)
        self.find_cameras = cache(mappers.find_cameras)

    def map(self, evidence: Evidence, chances: int = OVERLAPS.max_passes) -> Outcome:
        """Map all groups from new relative poses, again up to `chances` times where parts merge two places."""
        graph = build_pose_graph(evidence, self.pose_options, self.run.map)
        outcome = Outcome((), graph, evidence, evidence.intrinsics, self.run)
        self.write(outcome)
        trusted, groups = outcome.trusted, list[MappedGroup]()
        for number, photos in enumerate(graph.groups):
            if number and len(photos) < MAPPING.min_photos:
                continue
            results, joins = self._map_by_size(Group(photos, trusted, graph), stop_at_false_joins=chances > 0)
            if joins:
                return self._map_without(joins, outcome, chances - 1)
            best = best_attempt(results)
            groups.append(MappedGroup(results, best, [] if best is None else split_attempt(best, self.run)))
        return _outcome_of(groups, outcome)

    def _map_without(self, joins: Sequence[LookAlikes], outcome: Outcome, chances: int) -> Outcome:
        """Map without false joins of parts; joins without which the photos fall apart are doubtful."""
        self.run.progress.say("two different places are merged in a part; remapping without the ambiguous pairs")
        marked = replace(outcome, graph=with_false_joins(outcome.graph, joins))
        again = self.map(marked.trusted, chances)
        if again.main is not None and again.main.photos >= MAPPING.enough_share * len(outcome.graph.groups[0]):
            return again.with_earlier(marked)
        first = self.map(outcome.trusted, 0).with_earlier(outcome)
        return replace(first, graph=replace(first.graph, doubtful=(*first.graph.doubtful, *joins)))

    def _map_by_size(
        self, group: Group, *, stop_at_false_joins: bool
    ) -> tuple[list[MappingResult], tuple[LookAlikes, ...]]:
        """Map a large group in parts, others as a whole; or return the false joins that stop the mapping."""
        if not self.mappers.part_size(len(group.photos), self.run.settings.scene):
            return self.mappers.map_group(group, self.run), ()
        attempts, joins = self.mappers.map_in_parts(
            group, pairs_to_map(group.graph), self.run, stop_at_false_joins=stop_at_false_joins
        )
        if joins or parts_suffice(attempts, len(group.photos)):
            return attempts, joins
        return [*attempts, *self.mappers.map_group(group, self.run)], ()

    @property
    def pose_options(self) -> PoseGraphOptions:
        """Options of relative poses."""
        epipolar = self.run.settings.epipolar
        look_alikes = self.run.settings.scene.tries("look-alikes")
        return PoseGraphOptions(epipolar.max_error_px, epipolar.min_inliers, self.run.seed, look_alikes)

    def with_poses_of(self, models: Sequence[Attempt], outcome: Outcome) -> PoseGraph:
        """Return the pose graph with poses from other models, whose tracks later steps complete along its pairs."""
        graph, options = outcome.graph, self.pose_options
        for attempt in models:
            poses = model_poses(attempt.model, outcome.trusted.matches, options.max_error_px, options.min_inliers)
            graph = with_model(graph, set(posed_photo_ids(attempt.model)), poses)
        return graph

    def write(self, outcome: Outcome) -> None:
        """Write the cameras and relative poses of an outcome into the database of its run."""
        database, matches = outcome.run.workspace.database, outcome.evidence.matches
        with translate_errors("writing relative poses"):
            write_calibrations(database, matches, outcome.evidence.intrinsics)
            write_pose_graph(database, matches, pairs_to_map(outcome.graph))
