"""Place new photos in the model of an earlier run, and judge whether that explains as much as mapping all again.

The poses of known photos are a start, not a given: the last adjustment refines them with all others. Holding them would
keep the errors that the new photos could correct.
"""

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

from sfm_app.colmap.backend import CancellationToken, Reconstruction, run_interruptible, translate_errors
from sfm_app.colmap.database import write_calibrations, write_match_graph, write_pose_graph
from sfm_app.colmap.growth import model_in_database
from sfm_app.colmap.mapping import incremental_options, map_incrementally
from sfm_app.colmap.model import posed_photo_ids, submodel
from sfm_app.errors import BackendError
from sfm_app.estimation.calibrating import find_intrinsics
from sfm_app.mapping.attempt import (
    INCREMENTAL_FOLDER,
    MAPPING,
    Attempt,
    Group,
    best_attempt,
    explained_pairs,
    is_focal_accurate,
    judge_model,
    map_group,
    model_poses,
    pairs_to_map,
    support,
)
from sfm_app.mapping.feature_retry import MappedScene
from sfm_app.mapping.look_alikes import drop_look_alikes, judge_places
from sfm_app.mapping.passes import Outcome, reconstruct, rival_reason
from sfm_app.mapping.split_and_merge import split_attempt
from sfm_app.matching.pairs import find_same_matches
from sfm_app.posegraph import PoseGraphOptions, build_pose_graph
from sfm_app.runtime.context import Earlier, RunContext
from sfm_app.types import Intrinsics, LookAlikes, MatchGraph, PoseGraph, ViewGraph

logger = logging.getLogger("sfm_app")

GROWN = "grown"
"""Name of this mapper in the manifest."""
TWO_PLACES = "two different places are merged in the model"
"""The doubt of a grown model with false joins."""


def find_cameras(matches: MatchGraph, views: ViewGraph, run: RunContext) -> Intrinsics:
    """Find the cameras of all photos anew; the record of the run stays."""
    return find_intrinsics(matches, views, replace(run, statistics={}))[0]


@dataclass(frozen=True, slots=True)
class Steps:
    """Steps of mapping; tests pass others."""

    find_cameras: Callable[[MatchGraph, ViewGraph, RunContext], Intrinsics] = find_cameras
    reconstruct: Callable[..., Outcome] = reconstruct
    build_pose_graph: Callable[..., PoseGraph] = build_pose_graph
    rival_reason: Callable[..., str] = rival_reason
    judge_places: Callable[[Sequence[Attempt]], tuple[list[LookAlikes], int]] = judge_places


STEPS = Steps()


@dataclass(frozen=True, slots=True, eq=False)
class _Inputs:
    matches: MatchGraph
    views: ViewGraph
    intrinsics: Intrinsics
    run: RunContext
    steps: Steps


def map_new_photos(
    matches: MatchGraph,
    views: ViewGraph,
    intrinsics: Intrinsics,
    run: RunContext,
    earlier: Earlier,
    steps: Steps = STEPS,
) -> MappedScene:
    """Return the earlier model with the new photos, or new models of all photos where these explain more."""
    inputs = _Inputs(matches, views, intrinsics, run, steps)
    grown, doubt = _grow(inputs, earlier)
    run.record(grown_from=0 if grown is None else len(earlier.known), mapped_again_because=doubt)
    if grown is not None and not doubt:
        return MappedScene(grown, matches, views, intrinsics, run)
    run.progress.say(f"mapping all photos again (reason: {doubt})")
    cameras = steps.find_cameras(matches, views, run)
    whole = steps.reconstruct(matches, views, cameras, run)
    both = [outcome.models[0] for outcome in (grown, whole) if outcome is not None and outcome.models]
    is_folded = doubt == TWO_PLACES and bool(whole.models)  # look-alikes explain more, and are wrong
    if grown is None or is_folded or best_attempt(both) is not grown.models[0]:
        return MappedScene(whole, matches, views, cameras, run)
    _write_graph(grown.graph, inputs)
    return MappedScene(replace(grown, tried=(*whole.tried, *grown.tried)), matches, views, intrinsics, run)


def _grow(inputs: _Inputs, earlier: Earlier) -> tuple[Outcome | None, str]:
    """Return the earlier model with the new photos, if there is one, and why it is unreliable, if so."""
    matches, views, run = inputs.matches, inputs.views, inputs.run
    known_photos = find_same_matches(matches, earlier).photos
    with translate_errors("reading the earlier model"):
        write_match_graph(run.workspace.database, matches)
        write_calibrations(run.workspace.database, matches, inputs.intrinsics)
        counts = {photo: len(points) for photo, points in matches.keypoints.items()}
        start = model_in_database(run.workspace.database, earlier.place.sparse, known_photos, counts)
    placed = posed_photo_ids(start)
    if len(placed) < max(MAPPING.min_photos, 0.5 * len(matches.images)):
        return None, f"the earlier model holds only {len(placed)} of {len(matches.images)} photos"
    epipolar = run.settings.epipolar
    known = model_poses(start, matches, epipolar.max_error_px, epipolar.min_inliers)
    options = PoseGraphOptions(epipolar.max_error_px, epipolar.min_inliers, run.seed)
    graph = inputs.steps.build_pose_graph(matches, views, inputs.intrinsics, options, run.map, known)
    _write_graph(graph, inputs)
    matches, views = drop_look_alikes(matches, views, graph)
    connected = max(graph.groups, key=lambda photos: len(set(photos).intersection(placed)), default=())
    unconnected = set(placed).difference(connected)
    if unconnected:  # COLMAP does not take photos without a pair in the database
        placed = [photo for photo in placed if photo not in unconnected]
        start = submodel(start, placed)
    group = Group(connected, matches, views, graph, inputs.intrinsics)
    before = support(explained_pairs(start, matches, views, epipolar.max_error_px))
    model = _place(start, group, run)
    how = f"{len(placed)} photos were known"
    attempt = judge_model(matches, views, GROWN, how, model, run)
    if not isinstance(attempt, Attempt):
        return None, f"the earlier model takes no new photos ({attempt.note})"
    now, unplaced = set(posed_photo_ids(attempt.model)), set(connected).difference(placed)
    others = _map_others(graph, {*now, *connected}, replace(inputs, matches=matches, views=views))
    reason = f"{how}, and {len(unplaced & now)} of {len(unplaced)} others were registered"
    outcome = Outcome((attempt, *others), graph, inputs.intrinsics, (attempt.note,), reason)
    return outcome, _doubt(attempt, placed, before, replace(inputs, matches=matches, views=views))


def _doubt(attempt: Attempt, placed: Collection[int], before: float, inputs: _Inputs) -> str:
    """Return why a model grown from photos `placed`, with the support `before`, is unreliable; empty if it is not."""
    parts = split_attempt(attempt)
    if len(parts) != 1 or parts[0].photos != attempt.photos:
        return "matches contradict the joins of its parts"
    inside = set(placed)
    after = support({pair: one for pair, one in attempt.explained.items() if inside.issuperset(pair)})
    if after < (1.0 - MAPPING.equal_tolerance) * before:
        return "the model explains fewer matches of the known photos than the earlier one"
    if inputs.steps.judge_places([attempt])[0]:
        return TWO_PLACES
    return inputs.steps.rival_reason(attempt, inputs.intrinsics, inputs.matches, inputs.views)


def _write_graph(graph: PoseGraph, inputs: _Inputs) -> None:
    database = inputs.run.workspace.database
    with translate_errors("writing relative poses"):
        write_calibrations(database, inputs.matches, inputs.intrinsics)
        write_pose_graph(database, inputs.matches, pairs_to_map(graph))


def _place(start: Reconstruction, group: Group, run: RunContext) -> Reconstruction | None:
    placed = posed_photo_ids(start)
    unplaced = len(set(group.photos).difference(placed))
    if not unplaced:
        return submodel(start, placed)
    models = list[Reconstruction | None]()
    run.progress.start("mapping", unplaced)
    try:
        with translate_errors("mapping photos"):
            run_interruptible(lambda token: models.append(_extend(start, group, run, token)), lambda: None)
    except BackendError as err:  # all photos are mapped again
        logger.info("the earlier model could not be extended: %s", err)
        return None
    finally:
        run.progress.finish()
    return models[0]


def _extend(start: Reconstruction, group: Group, run: RunContext, token: CancellationToken) -> Reconstruction | None:
    cameras = {photo: group.intrinsics.camera(group.matches.images[photo]) for photo in group.photos}
    kept = {start.images[photo].camera_id for photo, camera in cameras.items() if camera.is_kept}
    place, is_known = run.workspace, all(is_focal_accurate(camera) for camera in cameras.values())
    return map_incrementally(
        place.database, place.photos, start, place.root / INCREMENTAL_FOLDER,
        incremental_options(run.seed, known=is_known, kept=kept), run.progress.advance, token,
    )  # fmt: skip


def _map_others(graph: PoseGraph, taken: Collection[int], inputs: _Inputs) -> list[Attempt]:
    models = []
    for photos in graph.groups:
        if len(photos) >= MAPPING.min_photos and not set(photos).intersection(taken):
            group = Group(photos, inputs.matches, inputs.views, graph, inputs.intrinsics)
            best = best_attempt(map_group(group, inputs.run))
            models += split_attempt(best) if best is not None else []
    return sorted(models, key=lambda attempt: (-attempt.photos, -attempt.support))
