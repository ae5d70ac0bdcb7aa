"""Place new photos in the model of an earlier run, and judge whether that explains as much as mapping all again.

The poses of known photos are a start, not a given: the last adjustment refines them with all others. Holding them would
keep the errors that the new photos could correct.
"""

import logging
from collections.abc import Collection, Sequence
from dataclasses import replace

from sfm_app.colmap.backend import Reconstruction, translate_errors
from sfm_app.colmap.database import write_calibrations, write_match_graph
from sfm_app.colmap.growth import model_in_database
from sfm_app.colmap.model import posed_photo_ids, submodel
from sfm_app.errors import BackendError
from sfm_app.estimation.calibrating import find_intrinsics
from sfm_app.mapping.attempt import (
    MAPPING,
    Attempt,
    Group,
    best_attempt,
    doubt,
    explained_pairs,
    extend_model,
    judge_model,
    map_group,
    model_poses,
    support,
)
from sfm_app.mapping.hypotheses import (
    ALL,
    FINER_FEATURES,
    FIRST_LOOK,
    Hypothesis,
    improve,
    photos_with_geometry,
    reconstruct,
    with_doubtful_joins,
)
from sfm_app.mapping.passes import MAPPERS, Mapper, Outcome
from sfm_app.mapping.splits import split_attempt
from sfm_app.matching.pairs import find_same_matches
from sfm_app.posegraph import build_pose_graph
from sfm_app.runtime.context import Earlier, RunContext
from sfm_app.types import Evidence, Intrinsics, MatchGraph, PoseGraph, ViewGraph

logger = logging.getLogger("sfm_app")

GROWN = "grown"
"""Name of this mapper in the manifest."""


def find_cameras(matches: MatchGraph, views: ViewGraph, run: RunContext) -> Intrinsics:
    """Find the cameras of all photos anew; the record of the run stays."""
    return find_intrinsics(matches, views, replace(run, statistics={}))


def map_new_photos(evidence: Evidence, run: RunContext, earlier: Earlier) -> Outcome:
    """Return the earlier model with the new photos, or new models of all photos where these explain more."""
    grown, reason = _grow(evidence, run, earlier)
    run.record(grown_from=0 if grown is None else len(earlier.known), mapped_again_because=reason)

    def map_anew(hypotheses: Sequence[Hypothesis]) -> Outcome:
        cameras = find_cameras(evidence.matches, evidence.views, run)
        return reconstruct(replace(evidence, intrinsics=cameras), run, hypotheses=hypotheses)

    if grown is None:
        run.progress.say(f"mapping all photos again (reason: {reason})")
        return map_anew(ALL)
    anew = Hypothesis("mapped-anew", lambda *_: reason, lambda *_: iter([map_anew(FIRST_LOOK)]))
    mapper = Mapper(run, MAPPERS)
    return with_doubtful_joins(improve(grown, mapper, [anew, FINER_FEATURES]), mapper)


def _grow(evidence: Evidence, run: RunContext, earlier: Earlier) -> tuple[Outcome | None, str]:
    """Return the earlier model with the new photos, if there is one, and why it is unreliable, if so."""
    matches = evidence.matches
    known_photos = find_same_matches(matches, earlier).photos
    with translate_errors("reading the earlier model"):
        write_match_graph(run.workspace.database, matches)
        write_calibrations(run.workspace.database, matches, evidence.intrinsics)
        counts = {photo: len(points) for photo, points in matches.keypoints.items()}
        start = model_in_database(run.workspace.database, earlier.place.sparse, known_photos, counts)
    placed = posed_photo_ids(start)
    if len(placed) < max(MAPPING.min_photos, 0.5 * len(matches.images)):
        return None, f"the earlier model holds only {len(placed)} of {len(matches.images)} photos"
    epipolar = run.settings.epipolar
    known = model_poses(start, matches, epipolar.max_error_px, epipolar.min_inliers)
    mapper = Mapper(run)
    graph = build_pose_graph(evidence, mapper.pose_options, run.map, known)
    outcome = Outcome((), graph, evidence, evidence.intrinsics, run)
    mapper.write(outcome)
    trusted = outcome.trusted
    connected = max(graph.groups, key=lambda photos: len(set(photos).intersection(placed)), default=())
    unconnected = set(placed).difference(connected)
    if unconnected:  # COLMAP does not take photos without a pair in the database
        placed = [photo for photo in placed if photo not in unconnected]
        start = submodel(start, placed)
    before = support(explained_pairs(start, trusted, epipolar.max_error_px))
    model = _place(start, Group(connected, trusted, graph), run)
    how = f"{len(placed)} photos were known"
    attempt = judge_model(trusted, GROWN, how, model, run)
    if not isinstance(attempt, Attempt):
        return None, f"the earlier model takes no new photos ({attempt.note})"
    now, unplaced = set(posed_photo_ids(attempt.model)), set(connected).difference(placed)
    others = _map_others(graph, {*now, *connected}, trusted, run)
    reason = f"{how}, and {len(unplaced & now)} of {len(unplaced)} others were registered"
    outcome = replace(outcome, models=(attempt, *others), notes=(attempt.note,), reason=reason)
    return outcome, _doubt(attempt, placed, before, trusted, run)


def _doubt(attempt: Attempt, placed: Collection[int], before: float, evidence: Evidence, run: RunContext) -> str:
    """Return why a model grown from photos `placed`, with the support `before`, is unreliable; empty if it is not."""
    parts = split_attempt(attempt, run)
    if len(parts) != 1 or parts[0].photos != attempt.photos:
        return "matches contradict the joins of its parts"
    inside = set(placed)
    after = support({pair: one for pair, one in attempt.explained.items() if inside.issuperset(pair)})
    if after < (1.0 - MAPPING.equal_tolerance) * before:
        return "the model explains fewer matches of the known photos than the earlier one"
    if MAPPERS.judge_places((attempt,))[0]:
        return "two different places are merged in the model"
    return doubt(attempt, len(photos_with_geometry(evidence)), evidence)


def _place(start: Reconstruction, group: Group, run: RunContext) -> Reconstruction | None:
    placed = posed_photo_ids(start)
    if not set(group.photos).difference(placed):
        return submodel(start, placed)
    try:
        return extend_model(group, start, run)
    except BackendError as err:  # all photos are mapped again
        logger.info("the earlier model could not be extended: %s", err)
        return None


def _map_others(graph: PoseGraph, taken: Collection[int], evidence: Evidence, run: RunContext) -> list[Attempt]:
    models = []
    for photos in graph.groups:
        if len(photos) >= MAPPING.min_photos and not set(photos).intersection(taken):
            best = best_attempt(map_group(Group(photos, evidence, graph), run))
            models += split_attempt(best, run) if best is not None else []
    return sorted(models, key=lambda attempt: (-attempt.photos, -attempt.support))
