"""Join models that see the same points by a similarity.

Mapping ends where the next photo shares too little with the photos before it. Two models that grew from either end may
still share points: matches between their photos that both models have triangulated. Three such points determine the
similarity between the models; the others, and the pairs between the models, verify it.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.bundle import adjust_or_keep
from sfm_app.colmap.models.joined_model import merge_models
from sfm_app.colmap.models.model import points_by_keypoint, posed_photo_ids
from sfm_app.colmap.types import Reconstruction
from sfm_app.geometry.similarity import robust_similarity
from sfm_app.numerical import FAILURES
from sfm_app.reconstruction.mapping_runs import Attempt, NoModel, judge_model
from sfm_app.reconstruction.model_split import sound_parts
from sfm_app.runtime.context import RunContext
from sfm_app.types import MatchGraph, ViewGraph

FloatArray = NDArray[np.float64]

LEAST_SHARED = 8
"""Smallest number of shared points for a join: three determine a similarity, twice as many may be wrong."""


def join_models(
    models: tuple[Attempt, ...], matches: MatchGraph, views: ViewGraph, run: RunContext
) -> tuple[Attempt, ...]:
    """Join to the first model all others that can be joined; the rest stay unchanged.

    Args:
        models: the main model first; no two hold the same photo.
        matches: keypoints and raw matches.
        views: fundamental matrices; their inliers are the points that models may share.
        run: the run.
    """
    main, others = models[0], list(models[1:])
    waiting = list(others)
    while waiting:
        other = waiting.pop(0)
        together = _join_pair(main, other, matches, views, run)
        if together is not None:
            main = together
            others.remove(other)
            waiting = list(others)
    return (main, *others)


def _join_pair(
    first: Attempt, second: Attempt, matches: MatchGraph, views: ViewGraph, run: RunContext
) -> Attempt | None:
    """Join both models; return None where they share too few points, or matches contradict the join."""
    shared = shared_points(first.model, second.model, matches, views)
    if len(shared) < LEAST_SHARED:
        return None
    try:
        similarity = robust_similarity(shared[:, 3:], shared[:, :3])
    except FAILURES:  # on a line
        return None
    database: Path = run.workspace.database
    with translate_errors("joining two models"):
        model = merge_models(database, first.model, second.model, similarity)
    model = adjust_or_keep(model, database).model
    how = f"{first.photos} and {second.photos} photos joined by {len(shared)} points"
    found = judge_model(matches, views, (first.mapper, how), model, run)
    if (
        isinstance(found, NoModel)
        or found.photos < first.photos + second.photos
        or found.support <= first.support + second.support
    ):
        return None
    one = len(sound_parts(found.explained, posed_photo_ids(found.model))) == 1
    return replace(found, note=how) if one else None


def shared_points(first: Reconstruction, second: Reconstruction, matches: MatchGraph, views: ViewGraph) -> FloatArray:
    """Return (N, 6) points that both models hold, in the frame of the first and of the second; each only once.

    Args:
        first, second: models that share no photo.
        matches: keypoints and raw matches.
        views: fundamental matrices; only their inliers are used.
    """
    here, there = points_by_keypoint(first), points_by_keypoint(second)
    found = {}
    for a, b in _pairs_between(views, {photo for photo, _ in here}, {photo for photo, _ in there}):
        pair = min(a, b), max(a, b)
        for row in matches.matches[pair][views.fits[pair].inliers]:
            row_of = dict(zip(pair, map(int, row), strict=True))
            one, other = here.get((a, row_of[a])), there.get((b, row_of[b]))
            if one is not None and other is not None:
                found[one[0]] = np.concatenate([one[1], other[1]])
    return np.array([found[key] for key in sorted(found)]).reshape(-1, 6)


def _pairs_between(views: ViewGraph, here: set[int], there: set[int]) -> Iterator[tuple[int, int]]:
    """Yield pairs with geometry between two sets of photos, the photo of the first set first."""
    for a, b in views.fits:
        if a in here and b in there:
            yield a, b
        elif b in here and a in there:
            yield b, a
