"""Finer features for unregistered photos and their likely neighbors, then another reconstruction.

On plain objects and over wide baselines the usual features are few. Affine shape, domain-size pooling, a lower contrast
threshold and a looser ratio test give more there. For all photos they would cost too much.
"""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import read_features, write_match_graph
from sfm_app.colmap.model import posed_photo_ids
from sfm_app.errors import ClusterError, SfmError
from sfm_app.estimation.calibrating import find_intrinsics
from sfm_app.estimation.fitting import fit_pairs, to_view_graph
from sfm_app.mapping.attempt import Attempt, NoModel, are_many_unregistered, best_attempt, judge_model, photo_names
from sfm_app.mapping.passes import Outcome, reconstruct
from sfm_app.matching.features import fill_database
from sfm_app.numerical import Json
from sfm_app.plugins import SIFT_DSP
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import SubWorkspace
from sfm_app.types import Intrinsics, MatchGraph, PairId, ViewGraph
from sfm_app.types.arrays import FloatArray

Rows = NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class RetryOptions:
    """Finer features for unregistered photos."""

    same_px: float = 0.5
    """Keypoints nearer than this count as one; about the noise of SIFT. Chosen by hand."""
    max_ratio: float = 0.85
    """Largest ratio of the distances to the best and the second best descriptor. Chosen on dinoSparseRing."""
    all_pairs: int = 30
    """Up to this number of photos, unregistered ones are matched with all others. Chosen by hand."""
    neighbors: int = 8
    """Photos with most raw matches that each is matched with in larger sets. Chosen by hand."""
    in_order: int = 2
    """Photos before and after it by name that each is matched with there. Chosen by hand."""


OPTIONS = RetryOptions()


def add_matches(
    matches: MatchGraph, keypoints: Mapping[int, FloatArray], added: Mapping[PairId, Rows]
) -> tuple[MatchGraph, tuple[PairId, ...]]:
    """Add keypoints and matches whose ends have none in that pair; return the graph, and the pairs with more."""
    all_keypoints, numbers = dict(matches.keypoints), {}
    for photo, x in keypoints.items():
        all_keypoints[photo], numbers[photo] = _merge_keypoints(matches.keypoints[photo], x)
    rows, enriched = dict(matches.matches), []
    for pair, new_rows in added.items():
        known_rows = rows.get(pair, np.zeros((0, 2), np.uint32))
        renamed = np.column_stack([numbers[photo][new_rows[:, side]] for side, photo in enumerate(pair)])
        merged = _drop_repeats(np.vstack([known_rows, renamed.astype(np.uint32)]))
        if len(merged) > len(known_rows):
            rows[pair] = merged
            enriched.append(pair)
    return replace(matches, keypoints=all_keypoints, matches=dict(sorted(rows.items()))), tuple(sorted(enriched))


def _merge_keypoints(known: FloatArray, added: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return all keypoints of a photo, and the index of each added one among them."""
    from scipy.spatial import cKDTree

    numbers = len(known) + np.arange(len(added))
    if len(known) and len(added):
        distances, nearest = cKDTree(known).query(added)
        numbers = np.where(distances <= OPTIONS.same_px, nearest, numbers)
    return np.vstack([known.reshape(-1, 2), added]), numbers.astype(np.int64)


def _drop_repeats(rows: Rows) -> Rows:
    """Return the rows whose keypoints, in either photo, occur in no earlier row."""
    first = [np.isin(np.arange(len(rows)), np.unique(rows[:, side], return_index=True)[1]) for side in (0, 1)]
    return rows[first[0] & first[1]]


FOLDER, FEATURES = "second_look", "features"


@dataclass(frozen=True, slots=True, eq=False)
class MappedScene:
    """Models with their matches, geometry and cameras."""

    outcome: Outcome
    matches: MatchGraph
    views: ViewGraph
    intrinsics: Intrinsics
    run: RunContext
    """Run whose workspace holds the database of these matches."""


@dataclass(frozen=True, slots=True)
class Steps:
    """Steps of mapping; tests pass others."""

    fill_database: Callable[..., object] = fill_database
    find_intrinsics: Callable[..., tuple[Intrinsics, object]] = find_intrinsics
    reconstruct: Callable[..., Outcome] = reconstruct


STEPS = Steps()


def retry_lost_photos(first: MappedScene, steps: Steps = STEPS) -> MappedScene:
    """Map again with finer features for unregistered photos; return the result that registers more of them."""
    run, lost = first.run, lost_photos(first)
    if not lost or run.settings.matching.features == SIFT_DSP or not run.settings.scene.second_look:
        return first
    pairs = candidate_pairs(lost, first.matches)
    photos = sorted({photo for pair in pairs for photo in pair})
    count = "1 photo is" if len(lost) == 1 else f"{len(lost)} photos are"
    run.progress.say(f"{count} unregistered; extracting finer features in {len(photos)} photos")
    report: dict[str, Json] = {"photos": photo_names(lost, first.matches), "pairs": len(pairs)}
    try:
        second = _retry_pairs(first, pairs, report, steps)
    except ClusterError:  # the same command would give another scene on a cluster that stays
        raise
    except SfmError as err:  # the first result is not lost with it
        report["failed"], second = str(err), None
    counts = [_placed_count(one.outcome) for one in (first, second) if one is not None]
    accepted = second is not None and _places_and_explains_more(second, first)
    run.record(second_look=report | {"placed": counts, "taken": accepted})
    return second if second is not None and accepted else first


def lost_photos(scene: MappedScene) -> list[int]:
    """Return the photos missing in the main model; none where their share of a large set is too small."""
    models, images = scene.outcome.models, scene.matches.images
    registered = set(posed_photo_ids(models[0].model)) if models else set()
    lost = sorted(images.keys() - registered)
    return lost if are_many_unregistered(len(lost), len(images)) else []


def candidate_pairs(lost: Collection[int], matches: MatchGraph) -> list[PairId]:
    """Return pairs of lost photos with each other and with their likely neighbors."""
    photos = sorted(matches.images)
    if len(photos) <= OPTIONS.all_pairs:
        return [(a, b) for k, a in enumerate(photos) for b in photos[k + 1 :] if a in lost or b in lost]
    matched: dict[int, Counter[int]] = {photo: Counter() for photo in photos}
    for (a, b), rows in matches.matches.items():
        matched[a][b], matched[b][a] = len(rows), len(rows)
    by_name = sorted(photos, key=lambda photo: matches.images[photo].name)
    place = {photo: k for k, photo in enumerate(by_name)}
    pairs = set()
    for photo in lost:
        in_order = by_name[max(0, place[photo] - OPTIONS.in_order) : place[photo] + OPTIONS.in_order + 1]
        likely = sorted(matched[photo], key=lambda other: (-matched[photo][other], other))[: OPTIONS.neighbors]
        pairs |= {(min(photo, other), max(photo, other)) for other in (*in_order, *likely) if other != photo}
    return sorted(pairs)


def _retry_pairs(
    first: MappedScene, pairs: Sequence[PairId], report: dict[str, Json], steps: Steps
) -> MappedScene | None:
    """Run all steps from features to models once more; return None if there is no new geometry."""
    matching = first.run.settings.matching
    looser = matching.model_copy(update={"max_ratio": max(OPTIONS.max_ratio, matching.max_ratio)})
    run = replace(
        first.run,
        workspace=SubWorkspace(first.run.workspace, FOLDER),  # a killed run is resumed there
        settings=first.run.settings.model_copy(update={"matching": looser}),
        statistics={},
    )
    finer = replace(run, workspace=SubWorkspace(run.workspace, FEATURES))
    with translate_errors("extracting finer features"):
        if not finer.workspace.database.exists():
            write_match_graph(finer.workspace.database, replace(first.matches, keypoints={}, matches={}))
    steps.fill_database(run.plugins.feature_method(SIFT_DSP), finer, pairs)
    with translate_errors("adding matches"):
        matches, enriched = add_matches(first.matches, *read_features(finer.workspace.database))
        report["pairs_with_more_matches"] = len(enriched)
        if not enriched:
            return None
    fitted = to_view_graph(fit_pairs(matches, enriched, run, first.views.lenses))
    if not fitted.fits:  # such as of a photo of something else
        return None
    fitted_pairs = set(enriched)
    fits = {pair: fit for pair, fit in first.views.fits.items() if pair not in fitted_pairs}
    rejected = {pair: why for pair, why in first.views.rejected.items() if pair not in fitted_pairs}
    views = ViewGraph(
        dict(sorted((fits | dict(fitted.fits)).items())), rejected | dict(fitted.rejected), first.views.lenses
    )
    report["pairs_with_geometry"] = [len(first.views.fits), len(views.fits)]
    # where pairs determine the cameras of half of the photos, more pairs change little
    estimated = [first.intrinsics.camera(image).is_estimated for image in first.matches.images.values()]
    is_calibrated = 2 * sum(estimated) >= len(estimated)
    intrinsics = first.intrinsics if is_calibrated else steps.find_intrinsics(matches, views, run)[0]
    return MappedScene(steps.reconstruct(matches, views, intrinsics, run), matches, views, intrinsics, run)


def _placed_count(outcome: Outcome) -> int:
    return outcome.main.photos if outcome.main else 0


def _places_and_explains_more(second: MappedScene, first: MappedScene) -> bool:
    if not second.outcome.models or _placed_count(second.outcome) <= _placed_count(first.outcome):
        return False
    models = [_judge(second, scene.outcome) for scene in (first, second) if scene.outcome.models]
    return best_attempt(models) is models[-1]


def _judge(scene: MappedScene, outcome: Outcome) -> Attempt | NoModel:
    main = outcome.models[0]
    return judge_model(scene.matches, scene.views, main.mapper, main.note, main.model, scene.run)
