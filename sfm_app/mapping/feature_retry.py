"""Finer features for unregistered photos and their likely neighbors.

On plain objects and over wide baselines the usual features are few. Affine shape, a lower contrast threshold and a
looser ratio test give more there. For all photos they would cost too much.
"""

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import read_features, write_match_graph
from sfm_app.colmap.model import posed_photo_ids
from sfm_app.estimation.calibrating import find_evidence
from sfm_app.mapping.attempt import are_many_unregistered
from sfm_app.mapping.passes import Outcome
from sfm_app.matching.features import fill_database
from sfm_app.plugins import SIFT_AFFINE, FeatureMethod
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.cost_estimate import finer_minutes, minutes_text
from sfm_app.runtime.workspace import SubWorkspace
from sfm_app.types import Evidence, MatchGraph, PairId
from sfm_app.types.arrays import FloatArray, IndexArray

Rows = NDArray[np.uint32]


class OPTIONS:
    """Finer features for unregistered photos."""

    same_px: float = 0.5
    """Keypoints nearer than this count as one; about the noise of SIFT. Chosen by hand."""
    max_ratio: float = 0.85
    """Largest ratio of the distances to the best and the second best descriptor. Chosen on dinoSparseRing."""
    neighbors: int = 8
    """Photos with most raw matches that each unregistered photo is matched with. Chosen by hand."""
    in_order: int = 2
    """Photos before and after it by name that each is matched with. Chosen by hand."""


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


def _merge_keypoints(known: FloatArray, added: FloatArray) -> tuple[FloatArray, IndexArray]:
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


FOLDER, FEATURES = "finer", "features"


def finer_methods(run: RunContext) -> list[FeatureMethod]:
    """Return the features that see more than those of the run, cheap ones first: SIFT with affine shape, plug-ins."""
    features, chosen = run.plugins.features, run.settings.matching.features
    installed = (one for one in features.values() if one.sift is None and not one.unavailable())
    return [one for one in (features[SIFT_AFFINE], *installed) if one.name != chosen]


def lost_photos(best: Outcome) -> list[int]:
    """Return the photos missing in the main model; none where their share is small."""
    registered = set(posed_photo_ids(best.main.model)) if best.main else set()
    lost = sorted(best.evidence.matches.images.keys() - registered)
    return lost if are_many_unregistered(len(lost), len(best.evidence.matches.images)) else []


def candidate_pairs(lost: Collection[int], matches: MatchGraph) -> list[PairId]:
    """Return pairs of lost photos with each other and with their likely neighbors."""
    counts: Counter[tuple[int, int]] = Counter()
    for (a, b), rows in matches.matches.items():
        counts[a, b] = counts[b, a] = len(rows)
    by_name = sorted(matches.images, key=lambda photo: matches.images[photo].name)
    place, pairs = {photo: k for k, photo in enumerate(by_name)}, set[PairId]()
    for photo in lost:
        others = [other for other in by_name if other != photo]
        in_order = sorted(others, key=lambda other: abs(place[other] - place[photo]))
        likely = sorted(in_order, key=lambda other: -counts[photo, other])[: OPTIONS.neighbors]
        near = [other for other in others if abs(place[other] - place[photo]) <= OPTIONS.in_order]
        pairs |= {(min(photo, other), max(photo, other)) for other in (*near, *likely)}
    return sorted(pairs)


def find_finer_evidence(best: Outcome, method: FeatureMethod, run: RunContext) -> tuple[Evidence, RunContext] | None:
    """Find more features in lost photos and their likely neighbors, then geometry and cameras.

    Return the evidence, and a run in a folder of its own, where a killed run is resumed; None without new geometry.
    """
    first, matching = replace(best.evidence, intrinsics=best.calibrated), run.settings.matching
    pairs = candidate_pairs(lost_photos(best), first.matches)
    tried = set(chain(*pairs))
    sizes = [(image.width, image.height) for key, image in first.matches.images.items() if key in tried]
    if method.sift is None:
        time = f"{len(pairs)} pairs; {method.summary}"
    else:
        time = f"{minutes_text(finer_minutes(sizes, run.settings, run.workers))} more"
    run.progress.say(f"{method.name} features of {len(sizes)} photos: {time}")
    looser = matching.model_copy(update={"max_ratio": max(OPTIONS.max_ratio, matching.max_ratio)})
    run = replace(
        run,
        workspace=SubWorkspace(run.workspace, f"{FOLDER}-{method.name}"),
        settings=run.settings.model_copy(update={"matching": looser}),
        statistics={},
    )
    finer = replace(run, workspace=SubWorkspace(run.workspace, FEATURES))
    with translate_errors("extracting finer features"):
        if not finer.workspace.database.exists():
            write_match_graph(finer.workspace.database, replace(first.matches, keypoints={}, matches={}))
    fill_database(method, finer, pairs)
    with translate_errors("adding matches"):
        matches, enriched = add_matches(first.matches, *read_features(finer.workspace.database))
    if not enriched:
        return None
    evidence = find_evidence(matches, run, first)
    # none such as of a photo of something else
    return (evidence, run) if any(pair in evidence.views.fits for pair in enriched) else None
