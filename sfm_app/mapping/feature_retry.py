"""A second look at unregistered photos: finer features for them and likely neighbors, then another reconstruction.

On plain objects and over wide baselines the usual features find little. Features adapted to their surroundings (affine
shape, domain-size pooling), a lower contrast threshold and a looser ratio test find more there. For all photos they
would cost too much, and where all photos are registered they add nothing.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import read_features, write_match_graph
from sfm_app.colmap.model import posed_photo_ids
from sfm_app.errors import ClusterError, SfmError
from sfm_app.estimation.calibrating import find_intrinsics
from sfm_app.estimation.fitting import fit_pairs, to_view_graph
from sfm_app.mapping.attempt import Attempt, NoModel, are_worth_another_try, best_attempt, judge_model, photo_names
from sfm_app.mapping.passes import Outcome, reconstruct
from sfm_app.matching.features import fill_database
from sfm_app.numerical import Json
from sfm_app.plugins import SIFT_DSP
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import SubWorkspace
from sfm_app.types import Intrinsics, MatchGraph, PairId, ViewGraph
from sfm_app.types.arrays import FloatArray

# Merge matches of two kinds of features of the same photos.

Rows = NDArray[np.uint32]

SAME_PX = 0.5
"""Keypoints nearer than this count as one, so that tracks continue across kinds; about the noise of SIFT."""


def add_matches(
    matches: MatchGraph, keypoints: Mapping[int, FloatArray], added: Mapping[PairId, Rows]
) -> tuple[MatchGraph, tuple[PairId, ...]]:
    """Add keypoints and matches of another kind.

    Existing keypoints keep their positions and indices. An added match enters only if neither of its keypoints has a
    match in the other photo yet.

    Args:
        matches: existing keypoints and matches.
        keypoints: (N, 2) pixels of the added keypoints, by photo.
        added: (M, 2) indices of added keypoints, by pair.

    Returns:
        The merged match graph, and the pairs that have gained matches.
    """
    every, numbers = dict(matches.keypoints), {}
    for photo, found in keypoints.items():
        every[photo], numbers[photo] = _merge_keypoints(matches.keypoints[photo], found)
    rows, changed = dict(matches.matches), []
    for pair, new in added.items():
        known = rows.get(pair, np.zeros((0, 2), np.uint32))
        renamed = np.column_stack([numbers[photo][new[:, side]] for side, photo in enumerate(pair)])
        together = _drop_repeats(np.vstack([known, renamed.astype(np.uint32)]))
        if len(together) > len(known):
            rows[pair] = together
            changed.append(pair)
    return replace(matches, keypoints=every, matches=dict(sorted(rows.items()))), tuple(sorted(changed))


def _merge_keypoints(known: FloatArray, found: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return all keypoints of a photo, and the index of each added one among them."""
    numbers = len(known) + np.arange(len(found))
    if len(known) and len(found):
        away, nearest = cKDTree(known).query(found)
        numbers = np.where(away <= SAME_PX, nearest, numbers)
    return np.vstack([known.reshape(-1, 2), found]), numbers.astype(np.int64)


def _drop_repeats(rows: Rows) -> Rows:
    """Return the rows whose keypoints, in either photo, occur in no earlier row."""
    first = [np.isin(np.arange(len(rows)), np.unique(rows[:, side], return_index=True)[1]) for side in (0, 1)]
    return rows[first[0] & first[1]]


FOLDER, FEATURES = "second_look", "features"
LOOSE_RATIO = 0.85
"""Largest ratio of the distances to the best and the second best descriptor. Chosen on dinoSparseRing: of its weakest
links 19, 22, 31 and 43 matches are right at 0.8 (of 33, 30, 39, 51), and 26, 29, 45 and 55 at 0.85 (of 58, 52, 81, 77):
9 + 6 photos in two models become 15 in one."""
ALL_PAIRS = 30
"""Up to this number of photos, unregistered ones are matched with all others."""
NEIGHBORS, IN_ORDER = 8, 2
"""In larger sets, each is matched with this number of photos with most raw matches, and with this number before and
after it by name."""


@dataclass(frozen=True, slots=True, eq=False)
class MappedScene:
    """Models, and the matches, geometry and cameras they were made from."""

    outcome: Outcome
    matches: MatchGraph
    views: ViewGraph
    intrinsics: Intrinsics
    run: RunContext
    """Run whose workspace holds the database of these matches."""


def retry_lost_photos(first: MappedScene) -> MappedScene:
    """Look again at photos missing in the main model, and return the new result if it registers more of them.

    If the attempt fails, the first result is kept.
    """
    run, lost = first.run, lost_photos(first)
    if not lost or run.settings.matching.features == SIFT_DSP or not run.settings.scene.second_look:
        return first
    pairs = candidate_pairs(lost, first.matches)
    seen = sorted({photo for pair in pairs for photo in pair})
    without = "1 photo has no place" if len(lost) == 1 else f"{len(lost)} photos have no place"
    run.progress.say(f"{without}: finer features are sought in {len(seen)}")
    report: dict[str, Json] = {"photos": photo_names(lost, first.matches), "pairs": len(pairs)}
    try:
        second = _retry_pairs(first, pairs, report)
    except ClusterError:  # the same command would give another scene on a cluster that stays
        raise
    except SfmError as err:  # the first result is not lost with it
        report["failed"], second = str(err), None
    placed = [_placed_count(one.outcome) for one in (first, second) if one is not None]
    taken = second is not None and _is_better(second, first)
    run.record(second_look=report | {"placed": placed, "taken": taken})
    return second if second is not None and taken else first


def lost_photos(found: MappedScene) -> list[int]:
    """Return the photos missing in the main model; none where their share of a large set is too small."""
    models, images = found.outcome.models, found.matches.images
    placed = set(posed_photo_ids(models[0].model)) if models else set()
    lost = sorted(images.keys() - placed)
    return lost if are_worth_another_try(len(lost), len(images)) else []


def candidate_pairs(lost: Collection[int], matches: MatchGraph) -> list[PairId]:
    """Return pairs of lost photos with each other and with their likely neighbors.

    Args:
        lost: ids of unregistered photos.
        matches: raw matches of all photos.
    """
    every = sorted(matches.images)
    if len(every) <= ALL_PAIRS:
        return [(a, b) for k, a in enumerate(every) for b in every[k + 1 :] if a in lost or b in lost]
    matched: dict[int, Counter[int]] = {photo: Counter() for photo in every}
    for (a, b), rows in matches.matches.items():
        matched[a][b], matched[b][a] = len(rows), len(rows)
    by_name = sorted(every, key=lambda photo: matches.images[photo].name)
    place = {photo: k for k, photo in enumerate(by_name)}
    pairs = set()
    for photo in lost:
        around = by_name[max(0, place[photo] - IN_ORDER) : place[photo] + IN_ORDER + 1]
        likely = sorted(matched[photo], key=lambda other: (-matched[photo][other], other))[:NEIGHBORS]
        pairs |= {(min(photo, other), max(photo, other)) for other in (*around, *likely) if other != photo}
    return sorted(pairs)


def _retry_pairs(first: MappedScene, pairs: Sequence[PairId], report: dict[str, Json]) -> MappedScene | None:
    """Run all steps from features to models once more; return None if none of it is of use."""
    run = _side_run(first.run)
    finer = replace(run, workspace=SubWorkspace(run.workspace, FEATURES))
    with translate_errors("looking for finer features"):
        if not finer.workspace.database.exists():
            write_match_graph(finer.workspace.database, replace(first.matches, keypoints={}, matches={}))
    fill_database(run.plugins.feature_method(SIFT_DSP), finer, pairs)
    with translate_errors("adding matches"):
        matches, changed = add_matches(first.matches, *read_features(finer.workspace.database))
        report["pairs_with_more_matches"] = len(changed)
        if not changed:
            return None
    fitted = to_view_graph(fit_pairs(matches, changed, run, first.views.lenses))
    if not fitted.fits:  # such as of a photo of something else
        return None
    asked = set(changed)
    kept = {pair: fit for pair, fit in first.views.fits.items() if pair not in asked}
    refused = {pair: why for pair, why in first.views.rejected.items() if pair not in asked}
    views = ViewGraph(
        dict(sorted((kept | dict(fitted.fits)).items())), refused | dict(fitted.rejected), first.views.lenses
    )
    report["pairs_with_geometry"] = [len(first.views.fits), len(views.fits)]
    intrinsics = first.intrinsics if _is_mostly_calibrated(first) else find_intrinsics(matches, views, run)[0]
    return MappedScene(reconstruct(matches, views, intrinsics, run), matches, views, intrinsics, run)


def _is_mostly_calibrated(found: MappedScene) -> bool:
    """Return whether pairs determine the cameras of at least half of the photos; more pairs then change little."""
    images = found.matches.images.values()
    return 2 * sum(found.intrinsics.camera(image).is_estimated for image in images) >= len(images)


def _side_run(run: RunContext) -> RunContext:
    """Return the run with a separate workspace folder, in which a killed run is resumed."""
    place = SubWorkspace(run.workspace, FOLDER)
    loose = run.settings.matching.model_copy(update={"max_ratio": max(LOOSE_RATIO, run.settings.matching.max_ratio)})
    settings = run.settings.model_copy(update={"matching": loose})
    return replace(run, workspace=place, settings=settings, statistics={})


def _placed_count(outcome: Outcome) -> int:
    return outcome.models[0].photos if outcome.models else 0


def _is_better(second: MappedScene, first: MappedScene) -> bool:
    """Return whether the second main model places more photos, and explains more of all matches, old and new."""
    if not second.outcome.models or _placed_count(second.outcome) <= _placed_count(first.outcome):
        return False
    models = [_judge(second, found.outcome) for found in (first, second) if found.outcome.models]
    return best_attempt(models) is models[-1]


def _judge(found: MappedScene, outcome: Outcome) -> Attempt | NoModel:
    main = outcome.models[0]
    return judge_model(found.matches, found.views, (main.mapper, main.note), main.model, found.run)
