"""Map every group of photos, learn cameras from the model, and map again where that or another hypothesis may help."""

import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count

import numpy as np

from sfm_app.camera.models import GUESSED_FOCAL, guessed_camera_matrix
from sfm_app.colmap.backend import Reconstruction, run_interruptible, translate_errors
from sfm_app.colmap.database import keep_raw_matches, write_calibrations, write_match_graph, write_pose_graph
from sfm_app.colmap.mapping import copy_database, map_with_colmap_defaults
from sfm_app.colmap.model import cameras_by_photo, posed_photo_ids
from sfm_app.errors import BackendError
from sfm_app.mapping.attempt import (
    MAPPING,
    Attempt,
    Group,
    MappingResult,
    NoModel,
    are_many_unregistered,
    best_attempt,
    choice_reason,
    judge_model,
    map_group,
    model_poses,
    pairs_to_map,
    photo_names,
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
from sfm_app.settings import SceneSettings, Settings
from sfm_app.types import Calibration, Intrinsics, LookAlikes, MatchedImage, MatchGraph, PairId, PoseGraph, ViewGraph
from sfm_app.types.camera import PERSPECTIVE
from sfm_app.types.evidence import EpipolarFit

logger = logging.getLogger("sfm_app")

RIVAL_FOLDER = "rival"
RIVAL, RIVAL_NOTE = "colmap", "COLMAP's default pipeline"


@dataclass(frozen=True, slots=True)
class PassOptions:
    """When mapping is repeated, and when other hypotheses are tried and accepted."""

    max_passes: int = 4
    """Largest number of passes over all pairs; dinoSparseRing needs three. Measured."""
    other_focals: tuple[float, ...] = (0.6, 2.4, 4.8)
    """Guesses of the focal besides the usual one, in longer sides: steps of a factor of two. Chosen by hand."""
    focal_tolerance: float = 0.01
    """Relative change of a focal in mapping above which another pass is worth it. Chosen by hand."""
    min_unregistered_share: float = 0.25
    """Share of unregistered photos above which other focals are tried. Chosen by hand."""
    max_photos_for_focals: int = 60
    """Photos above which no other focals are tried. Chosen by hand."""
    min_contradicted_share: float = 0.05
    """Share of contradicting inliers of F above which a rival is tried; right models have 0.1 to 3 %. Measured."""
    min_photos: int = 5
    """With fewer photos, a camera per photo fits almost anything. Chosen by hand."""
    max_photos: int = 100
    """With more photos, a pass costs more than it promises. Chosen by hand."""
    max_remaining_share: float = 0.5
    """Share of the contradictions that may remain with a camera per photo. Chosen on `benchmarks.trouble`."""
    share_tolerance: float = 0.002
    """Largest increase of the contradicted share by two cameras instead of one per photo. Chosen by hand."""


OPTIONS = PassOptions()


# A rival where the evidence for our model is weak: COLMAP's default pipeline with the usual guess of the camera. It
# uses none of our fundamental matrices, cameras and poses, and so shares none of their errors.


def rival_reason(model: Attempt | None, intrinsics: Intrinsics, matches: MatchGraph, views: ViewGraph) -> str:
    """Return why a rival is worth trying, given the main model; empty where the evidence is good."""
    if model is None:
        return "no photo is registered"
    undetermined = {intrinsics.camera_name(image) for image in matches.images.values()} - {
        name for name, camera in intrinsics.cameras.items() if camera.is_estimated
    }
    if undetermined:
        return "the pairs do not determine a camera"
    connected = photos_with_geometry(views.fits)
    if are_many_unregistered(len(connected) - model.photos, len(connected)):
        return f"unregistered photos with matches: {len(connected) - model.photos}"
    inliers = sum(pair.inliers for pair in model.explained.values())
    against = sum(pair.contradicted for pair in model.explained.values())
    return (
        f"{100 * against / inliers:.0f} % of the matches contradict the model"
        if against > OPTIONS.min_contradicted_share * inliers
        else ""
    )


def photos_with_geometry(fits: Mapping[PairId, EpipolarFit]) -> set[int]:
    """Collect the photos of pairs whose geometry is not degenerate."""
    return {photo for pair, fit in fits.items() if not fit.degeneracy for photo in pair}


def map_baseline(matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics, run: RunContext) -> Attempt | NoModel:
    """Map the same matches with COLMAP's default pipeline and stated focals, and score the model like any other."""
    scratch = run.workspace.root / RIVAL_FOLDER
    models: list[Reconstruction | None] = []
    guess = guessed_intrinsics(intrinsics)
    try:
        with translate_errors("mapping photos with COLMAP's defaults"):
            copy_database(run.workspace.database, scratch)
            write_calibrations(scratch / "database.db", matches, guess)
            keep_raw_matches(scratch / "database.db", matches.matches)
            run_interruptible(
                lambda token: models.append(map_with_colmap_defaults(run.workspace.photos, scratch, run.seed, token)),
                lambda: None,
            )
    except BackendError as err:  # our own model is not lost with it
        logger.info("the rival failed: %s", err)
        return NoModel(RIVAL, f"{RIVAL_NOTE}: failed, {err}")
    return judge_model(matches, views, RIVAL, RIVAL_NOTE, models[0], run)


def is_focal_doubtful(model: Attempt | None, intrinsics: Intrinsics, views: ViewGraph) -> bool:
    """Return whether a wrong guess of the focal may be why photos that match others are unregistered."""
    connected = photos_with_geometry(views.fits)
    known = any(camera.is_estimated or camera.method == "exif" for camera in intrinsics.cameras.values())
    placed = model.photos if model is not None else 0
    return (
        not known
        and len(connected) <= OPTIONS.max_photos_for_focals
        and len(connected) - placed > OPTIONS.min_unregistered_share * len(connected)
    )


def guessed_intrinsics(intrinsics: Intrinsics, sides: float = GUESSED_FOCAL) -> Intrinsics:
    """Replace every perspective camera without a stated focal by a guess of `sides` longer sides."""
    cameras = {
        name: _guess(camera, sides * max(camera.width, camera.height), camera.reason)
        if camera.projection == PERSPECTIVE and camera.method != "exif" and not camera.is_given
        else camera
        for name, camera in intrinsics.cameras.items()
    }
    return replace(intrinsics, cameras=cameras)


# A camera per photo, for a zoom or several devices. Photos of one size share a camera until their pairs contradict
# that. Pairs of a camera that moves forward or round one point never do. A model does: with one focal, it contradicts
# matches that are right pair by pair.


def is_shared_camera_doubtful(
    model: Attempt | None, intrinsics: Intrinsics, views: ViewGraph, settings: Settings
) -> bool:
    """Return whether photos of one size may have a camera each: the model is contradicted, or lacks many photos."""
    if model is None or settings.photos.cameras != "auto":
        return False
    if (
        not OPTIONS.min_photos <= max(model.photos, len(photos_with_geometry(views.fits))) <= OPTIONS.max_photos
    ):  # pairs on a plane are not counted as fits
        return False
    return _contradicted_share(model) > MAPPING.max_contradicted_share or is_focal_doubtful(model, intrinsics, views)


def with_camera_per_photo(model: Attempt, shared: Intrinsics, matches: MatchGraph) -> Intrinsics | None:
    """Give each photo its own camera where pairs do not determine the shared one; None if there is none such."""
    focals = {photo: float(K[0, 0] * K[1, 1]) ** 0.5 for photo, (K, *_) in cameras_by_photo(model.model).items()}
    placed = posed_photo_ids(model.model)
    focal_of = {shared.camera_name(matches.images[photo]): focals[photo] for photo in placed if photo in focals}
    members: dict[str, list[MatchedImage]] = {}
    for image in matches.images.values():
        members.setdefault(shared.camera_name(image), []).append(image)
    divided = [name for name, images in members.items() if len(images) > 1 and not shared.cameras[name].identifiable]
    if not divided:
        return None
    cameras, camera_of = dict(shared.cameras), dict(shared.camera_of)
    for name in divided:
        camera = cameras.pop(name)
        focal_px, reason = focal_of.get(name, camera.focal_px), "its photos may each be of another camera"
        names = _free_names(name, {*shared.cameras, *cameras})
        for image, own in zip(sorted(members[name], key=lambda image: image.name), names, strict=False):
            cameras[own], camera_of[image.name] = _guess(camera, focal_px, reason), own
    return replace(shared, cameras=cameras, camera_of=camera_of)


def with_two_cameras(model: Attempt, each: Intrinsics, matches: MatchGraph) -> Intrinsics | None:
    """Replace the cameras of photos of one size by two, divided at the widest gap of focals; None if none can be."""
    of_size: dict[tuple[int, int], dict[str, float]] = {}
    for photo, (K, *_) in cameras_by_photo(model.model).items():
        name = each.camera_name(matches.images[photo])
        if not each.cameras[name].identifiable:
            size = each.cameras[name].width, each.cameras[name].height
            of_size.setdefault(size, {})[name] = float(K[0, 0] * K[1, 1]) ** 0.5
    cameras = dict(each.cameras)
    replacements: dict[str, str] = {}
    for size, focals in of_size.items():
        for group in _split_at_gap(focals):
            K = guessed_camera_matrix(size, float(np.median([focals[name] for name in group])))
            cameras[group[0]] = replace(cameras[group[0]], K=K, identifiable=True, reason="", method="mapping")
            replacements |= dict.fromkeys(group[1:], group[0])
    camera_of = {photo: replacements.get(name, name) for photo, name in each.camera_of.items()}
    used = {name: camera for name, camera in cameras.items() if name not in replacements}
    return replace(each, cameras=used, camera_of=camera_of) if replacements else None


def two_cameras_suffice(two: Attempt | None, own: Attempt) -> bool:
    """Return whether a model with two cameras explains the matches as well as one with a camera per photo."""
    if two is None or two.photos < own.photos or two.support < (1.0 - MAPPING.equal_tolerance) * own.support:
        return False
    return _contradicted_share(two) <= _contradicted_share(own) + OPTIONS.share_tolerance


def camera_per_photo_explains_more(own: Attempt | None, shared: Attempt) -> bool:
    """Return whether a camera per photo explains more matches, and registers more photos or removes contradictions."""
    if own is None or own.photos < shared.photos or own.support <= shared.support:
        return False
    return own.photos > shared.photos or _contradicted_share(own) <= OPTIONS.max_remaining_share * _contradicted_share(
        shared
    )


def _contradicted_share(model: Attempt) -> float:
    inliers = sum(pair.inliers for pair in model.explained.values())
    return sum(pair.contradicted for pair in model.explained.values()) / max(inliers, 1)


def _split_at_gap(focals: Mapping[str, float]) -> list[list[str]]:
    """Return names in two parts, divided at the widest gap between focals; empty if a part has only one name."""
    names = sorted(focals, key=lambda name: (focals[name], name))
    if len(names) < OPTIONS.min_photos:
        return []
    gap = int(np.argmax(np.diff(np.log([focals[name] for name in names])))) + 1
    return [names[:gap], names[gap:]] if 2 <= gap <= len(names) - 2 else []


def _free_names(name: str, taken: Collection[str]) -> Iterable[str]:
    """Return the name itself, then numbered variants of it that are not taken."""
    return chain([name], (other for number in count(2) if (other := f"{name} #{number}") not in taken))


def _guess(camera: Calibration, focal_px: float, reason: str) -> Calibration:
    size = camera.width, camera.height
    return Calibration(guessed_camera_matrix(size, focal_px), *size, "guess", identifiable=False, reason=reason)


# The passes.


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
