"""Map every group of photos, learn cameras from the model, and map again where that may help."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import write_calibrations, write_match_graph, write_pose_graph
from sfm_app.colmap.model import cameras_by_photo, posed_photo_ids
from sfm_app.mapping.attempt import (
    MAPPING,
    Attempt,
    Group,
    MappingResult,
    NoModel,
    are_many_unregistered,
    best_attempt,
    choice_reason,
    map_group,
    model_poses,
    pairs_to_map,
    photo_names,
)
from sfm_app.mapping.hypotheses import (
    camera_per_photo_explains_more,
    guessed_intrinsics,
    is_focal_doubtful,
    is_shared_camera_doubtful,
    map_baseline,
    rival_reason,
    two_cameras_suffice,
    with_camera_per_photo,
    with_two_cameras,
)
from sfm_app.mapping.look_alikes import (
    OVERLAPS,
    drop_look_alikes,
    judge_places,
    with_earlier_look_alikes,
    with_false_joins,
)
from sfm_app.mapping.parts import map_in_parts, part_size, parts_suffice
from sfm_app.mapping.split_and_merge import merge_into_main, split_attempt
from sfm_app.posegraph import PoseGraphOptions, build_pose_graph, with_model
from sfm_app.runtime.context import RunContext
from sfm_app.settings import SceneSettings
from sfm_app.types import Calibration, Intrinsics, LookAlikes, MatchGraph, PoseGraph, ViewGraph


@dataclass(frozen=True, slots=True)
class PassOptions:
    """When mapping is repeated."""

    max_passes: int = 4
    """Largest number of passes over all pairs; dinoSparseRing needs three. Measured."""
    other_focals: tuple[float, ...] = (0.6, 2.4, 4.8)
    """Guesses of the focal besides the usual one, in longer sides: steps of a factor of two. Chosen by hand."""
    focal_tolerance: float = 0.01
    """Relative change of a focal in mapping above which another pass is worth it. Chosen by hand."""


OPTIONS = PassOptions()


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Models of all groups, before the last adjustment."""

    models: tuple[Attempt, ...]
    """The main model first."""
    graph: PoseGraph
    intrinsics: Intrinsics
    """Cameras that the models were mapped with."""
    tried: tuple[str, ...]
    reason: str = ""
    """Why the attempt behind the main model was chosen."""
    cuts: tuple[str, ...] = ()
    """Names of the photos of each part of a model that was cut because matches contradict the join."""
    passes: int = 1
    rival_reason: str = ""
    one_camera_each: str = ""
    """Result of trying a camera for each photo: "taken", "left" (rejected), or "two" where two cameras explain as much;
    empty if it was not tried."""

    @property
    def main(self) -> Attempt | None:
        """The main model, if there is one."""
        return self.models[0] if self.models else None

    @property
    def support(self) -> float:
        """Support of the main model; 0 without one."""
        return self.models[0].support if self.models else 0.0


@dataclass(frozen=True, slots=True)
class Mappers:
    """Functions that map a group and judge its model; tests pass others."""

    part_size: Callable[[int, SceneSettings], int] = part_size
    map_group: Callable[[Group, RunContext], list[MappingResult]] = map_group
    map_in_parts: Callable[..., tuple[list[MappingResult], tuple[LookAlikes, ...]]] = map_in_parts
    map_baseline: Callable[..., Attempt | NoModel] = map_baseline
    judge_places: Callable[[Iterable[Attempt]], tuple[list[LookAlikes], int]] = judge_places


MAPPERS = Mappers()


def reconstruct(
    matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics, run: RunContext, mappers: Mappers = MAPPERS
) -> Outcome:
    """Return models of all connected groups of photos; none where no pair grows into a model.

    Where the evidence for a model is weak, a rival is mapped, and the model that explains more stays. Where cameras
    were guesses, or photos of the main group are missing, a second pass starts from the cameras of the model, which
    correct relative poses. Passes are repeated as long as they improve the model.
    """
    return Passes(run, mappers).reconstruct(matches, views, intrinsics)


class Passes:
    """Passes over all pairs of a run."""

    def __init__(self, run: RunContext, mappers: Mappers = MAPPERS) -> None:
        self.run, self.mappers = run, mappers

    def reconstruct(self, matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics) -> Outcome:
        """Return models of all connected groups of photos, see `reconstruct`."""
        with translate_errors("entering photos"):
            write_match_graph(self.run.workspace.database, matches)
        best = self._drop_false_joins(self.run_pass(matches, views, intrinsics), matches, views)
        matches, views = drop_look_alikes(matches, views, best.graph)
        best = self._try_rival(best, matches, views, intrinsics)
        best = self._try_other_focals(best, matches, views, intrinsics)
        best = self._try_camera_per_photo(best, matches, views, intrinsics)
        for number in range(2, OPTIONS.max_passes + 1):
            if not best.models or not needs_another_pass(best, best.intrinsics, matches):
                break
            learned = learned_intrinsics(best.models[0], best.intrinsics, matches)
            again = self.run_pass(matches, views, learned)
            if again.support <= best.support:
                self._write_graph(best.graph, best.intrinsics, matches)
                break
            graph, tried = with_earlier_look_alikes(again.graph, best.graph), best.tried + again.tried
            best = replace(
                again,
                passes=number,
                rival_reason=best.rival_reason,
                graph=graph,
                tried=tried,
                one_camera_each=best.one_camera_each,
            )
            matches, views = drop_look_alikes(matches, views, best.graph)
        return self.merge_models(best, matches, views)

    def _drop_false_joins(self, outcome: Outcome, matches: MatchGraph, views: ViewGraph) -> Outcome:
        """Map again without pairs that merge two places; joins without which the photos fall apart are doubtful."""
        joins, non_overlapping = self.mappers.judge_places(outcome.models)
        for _ in range(OVERLAPS.max_passes):
            if not joins:
                return outcome
            self.run.progress.say("two different places are merged in the model; remapping without the ambiguous pairs")
            marked = with_false_joins(outcome.graph, joins)
            again = self.run_pass(*drop_look_alikes(matches, views, marked), outcome.intrinsics)
            joins_now, non_overlapping_now = self.mappers.judge_places(again.models)
            tried = (*outcome.tried, *again.tried)
            holds_together = (
                again.main is not None and again.main.photos >= MAPPING.enough_share * outcome.models[0].photos
            )
            if not holds_together or 2 * non_overlapping_now > non_overlapping:
                self._write_graph(outcome.graph, outcome.intrinsics, matches)
                outcome = replace(outcome, tried=tried)
                break
            outcome = replace(again, graph=with_earlier_look_alikes(again.graph, marked), tried=tried)
            joins, non_overlapping = joins_now, non_overlapping_now
        return replace(outcome, graph=replace(outcome.graph, doubtful=(*outcome.graph.doubtful, *joins)))

    def _try_rival(self, outcome: Outcome, matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics) -> Outcome:
        """Map a rival where the evidence is weak, and return the outcome with the model that explains more."""
        main = outcome.main
        reason = rival_reason(main, intrinsics, matches, views)
        if not reason:
            return outcome
        self.run.progress.say(f"also trying COLMAP's default pipeline (reason: {reason})")
        rival = self.mappers.map_baseline(matches, views, intrinsics, self.run)
        outcome = replace(outcome, rival_reason=reason, tried=(*outcome.tried, rival.note))
        both = [attempt for attempt in (main, rival) if attempt is not None]
        if isinstance(rival, NoModel) or best_attempt(both) is not rival:
            return outcome
        parts = split_attempt(rival)
        taken = {photo for part in parts for photo in posed_photo_ids(part.model)}
        others = [model for model in outcome.models if taken.isdisjoint(posed_photo_ids(model.model))]
        models = sorted((*parts, *others), key=lambda attempt: (-attempt.photos, -attempt.support))
        graph = self._update_graph(models, outcome.graph, matches)
        self._write_graph(graph, intrinsics, matches)
        return replace(
            outcome, models=tuple(models), graph=graph, reason=choice_reason(rival, both, len(matches.images))
        )

    def _try_other_focals(
        self, outcome: Outcome, matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics
    ) -> Outcome:
        main = outcome.main
        if not is_focal_doubtful(main, intrinsics, views):
            return outcome
        self.run.progress.say(
            "many photos are unregistered and the focal length is a guess; trying other focal lengths"
        )
        for focal in OPTIONS.other_focals:
            other = self.run_pass(matches, views, guessed_intrinsics(intrinsics, focal))
            tried = (*outcome.tried, *(f"{note} (focal {focal:g} longer sides)" for note in other.tried))
            outcome = replace(
                other if other.support > outcome.support else outcome, rival_reason=outcome.rival_reason, tried=tried
            )
        if outcome.graph is not other.graph:
            self._write_graph(outcome.graph, outcome.intrinsics, matches)
        return outcome

    def _try_camera_per_photo(
        self, outcome: Outcome, matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics
    ) -> Outcome:
        main = outcome.main
        if main is None or not is_shared_camera_doubtful(main, intrinsics, views, self.run.settings):
            return outcome
        each = with_camera_per_photo(main, intrinsics, matches)
        if each is None:
            return outcome
        self.run.progress.say("a shared camera does not fit; trying one camera per photo")
        own = self.run_pass(matches, views, each)
        own = self._try_rival(own, matches, views, each)
        tried = (*outcome.tried, *(f"{note} (a camera for each photo)" for note in own.tried))
        if not camera_per_photo_explains_more(own.main, main):
            self._write_graph(outcome.graph, outcome.intrinsics, matches)
            return replace(outcome, tried=tried, one_camera_each="left")
        return self._try_two_cameras(
            replace(own, rival_reason=outcome.rival_reason, tried=tried, one_camera_each="taken"), matches, views, each
        )

    def _try_two_cameras(self, own: Outcome, matches: MatchGraph, views: ViewGraph, each: Intrinsics) -> Outcome:
        between = with_two_cameras(own.models[0], each, matches)
        if between is None:
            return own
        two = self.run_pass(matches, views, between)
        tried = (*own.tried, *(f"{note} (two cameras)" for note in two.tried))
        if two_cameras_suffice(two.main, own.models[0]):
            return replace(two, rival_reason=own.rival_reason, tried=tried, one_camera_each="two")
        self._write_graph(own.graph, own.intrinsics, matches)
        return replace(own, tried=tried)

    def merge_models(self, outcome: Outcome, matches: MatchGraph, views: ViewGraph) -> Outcome:
        """Return the outcome with models joined where they share points."""
        if len(outcome.models) < 2:
            return outcome
        models = merge_into_main(outcome.models, matches, views, self.run)
        if len(models) == len(outcome.models):
            return outcome
        self.run.progress.say(f"merged models: {models[0].note}")
        graph = self._update_graph(models[:1], outcome.graph, matches)
        self._write_graph(graph, outcome.intrinsics, matches)
        tried = (*outcome.tried, models[0].note)
        return replace(outcome, models=models, graph=graph, tried=tried, reason=models[0].note)

    def run_pass(
        self, matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics, chances: int = OVERLAPS.max_passes
    ) -> Outcome:
        """Map all groups from new relative poses, again up to `chances` times where parts merge two places."""
        epipolar = self.run.settings.epipolar
        options = PoseGraphOptions(epipolar.max_error_px, epipolar.min_inliers, self.run.seed)
        graph = build_pose_graph(matches, views, intrinsics, options, self.run.map)
        self._write_graph(graph, intrinsics, matches)
        matches, views = drop_look_alikes(matches, views, graph)
        models: list[Attempt] = []
        reasons: dict[str, str] = {}
        tried: list[str] = []
        cuts: list[str] = []
        for number, photos in enumerate(graph.groups):
            if number and len(photos) < MAPPING.min_photos:
                continue
            attempts, joins = self.map_by_size(
                Group(photos, matches, views, graph, intrinsics), stop_at_false_joins=chances > 0
            )
            if joins:
                return self._run_pass_without(joins, graph, intrinsics, matches, views, chances - 1)
            tried += [attempt.note for attempt in attempts]
            best = best_attempt(attempts)
            if best is not None:
                reasons[best.note] = choice_reason(best, attempts, len(photos))
                parts = split_attempt(best)
                models += parts
                cuts += [
                    ", ".join(photo_names(sorted(posed_photo_ids(part.model)), matches))
                    for part in parts
                    if len(parts) > 1
                ]
        models.sort(key=lambda attempt: (-attempt.photos, -attempt.support))
        reason = reasons[models[0].note] if models else ""
        return Outcome(tuple(models), graph, intrinsics, tuple(tried), reason, tuple(cuts))

    def _run_pass_without(
        self,
        joins: Sequence[LookAlikes],
        graph: PoseGraph,
        intrinsics: Intrinsics,
        matches: MatchGraph,
        views: ViewGraph,
        chances: int,
    ) -> Outcome:
        """Run a pass without false joins of parts; joins without which the photos fall apart are doubtful."""
        self.run.progress.say("two different places are merged in a part; remapping without the ambiguous pairs")
        marked = with_false_joins(graph, joins)
        again = self.run_pass(*drop_look_alikes(matches, views, marked), intrinsics, chances)
        if again.main is not None and again.main.photos >= MAPPING.enough_share * len(graph.groups[0]):
            return replace(again, graph=with_earlier_look_alikes(again.graph, marked))
        first = self.run_pass(matches, views, intrinsics, 0)
        return replace(first, graph=replace(first.graph, doubtful=(*first.graph.doubtful, *joins)))

    def map_by_size(
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

    def _update_graph(self, models: Sequence[Attempt], graph: PoseGraph, matches: MatchGraph) -> PoseGraph:
        """Return the pose graph with poses from other models, whose tracks later steps complete along its pairs."""
        epipolar = self.run.settings.epipolar
        for attempt in models:
            poses = model_poses(attempt.model, matches, epipolar.max_error_px, epipolar.min_inliers)
            graph = with_model(graph, set(posed_photo_ids(attempt.model)), poses)
        return graph

    def _write_graph(self, graph: PoseGraph, intrinsics: Intrinsics, matches: MatchGraph) -> None:
        with translate_errors("writing relative poses"):
            write_calibrations(self.run.workspace.database, matches, intrinsics)
            write_pose_graph(self.run.workspace.database, matches, pairs_to_map(graph))


def needs_another_pass(outcome: Outcome, intrinsics: Intrinsics, matches: MatchGraph) -> bool:
    """Return whether the cameras of the model differ from those of the pass, or main photos are missing."""
    main = outcome.models[0]
    placed = posed_photo_ids(main.model)
    if len(placed) < MAPPING.min_photos:
        return False
    learned = learned_intrinsics(main, intrinsics, matches)
    used = {intrinsics.camera_name(matches.images[photo]) for photo in placed}
    is_focal_new = any(_has_new_focal(intrinsics.cameras[name], learned.cameras[name]) for name in used)
    anywhere = {photo for model in outcome.models for photo in posed_photo_ids(model.model)}
    group = set(outcome.graph.connected_photos(placed[0]))
    return is_focal_new or are_many_unregistered(len(group - anywhere), len(group))


def learned_intrinsics(model: Attempt, intrinsics: Intrinsics, matches: MatchGraph) -> Intrinsics:
    """Replace the cameras of the photos of a model by its own."""
    with translate_errors("reading cameras"):
        learned = cameras_by_photo(model.model)
    cameras = dict(intrinsics.cameras)
    for photo, camera in learned.items():
        name = intrinsics.camera_name(matches.images[photo])
        earlier = intrinsics.cameras[name]
        if earlier.is_kept:
            continue
        # mapping holds a lens with all terms as it was given
        lens = earlier if earlier.distortion else replace(earlier, radial=camera.radial, fisheye=camera.fisheye)
        cameras[name] = replace(lens, K=camera.K, identifiable=True, reason="", method="mapping")
    return replace(intrinsics, cameras=cameras)


def _has_new_focal(before: Calibration, after: Calibration) -> bool:
    return not before.is_estimated or abs(float(np.log(after.focal_px / before.focal_px))) > OPTIONS.focal_tolerance
