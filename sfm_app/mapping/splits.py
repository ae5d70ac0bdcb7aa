"""Cut models at joins that matches contradict, and find loose joins."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sfm_app.colmap.backend import Reconstruction, all_points, translate_errors
from sfm_app.colmap.model import posed_images, posed_photo_ids, submodel
from sfm_app.mapping.attempt import MAPPING, Attempt, PairSupport
from sfm_app.posegraph.rotations import DisjointGroups
from sfm_app.runtime.context import RunContext
from sfm_app.types import PairId

if TYPE_CHECKING:
    from scipy.sparse import csr_array


# Cuts. A false join of similar facades rests on few matches, and leaves many others unexplained: those of pairs that
# see the true layout.


class OPTIONS:
    """When models are cut, and when a scale is loose."""

    min_matches: int = 16
    """Least matches with which a pair can join two parts. Chosen by hand."""
    min_common_points: int = 5
    """Points of two placed photos and the next one, below which the scale between them is undetermined. Measured."""


def sound_parts(explained: Mapping[PairId, PairSupport], photos: Iterable[int]) -> list[tuple[int, ...]]:
    """Return photos in parts whose joins more matches support than contradict, largest part first.

    Pairs are taken strongest first; two parts become one when the matches between them that the model explains
    outnumber the inliers of fundamental matrices between them that it does not.
    """
    groups = DisjointGroups(photos)
    weights = {pair: pair_support.matches - pair_support.contradicted for pair, pair_support in explained.items()}
    # by photo, the weight of its significant pairs with the others
    between: defaultdict[int, Counter[int]] = defaultdict(Counter)
    for (a, b), value in weights.items():
        if abs(value) >= OPTIONS.min_matches:
            between[a][b] += value
            between[b][a] += value
    for a, b in sorted(weights, key=lambda pair: (-weights[pair], pair)):
        first, second = groups.name[a], groups.name[b]
        if first == second or weights[a, b] < OPTIONS.min_matches or between[first][second] <= 0:
            continue
        groups.join(a, b)
        larger = groups.name[a]
        smaller = second if larger == first else first
        for other, value in between.pop(smaller).items():
            if other != larger:
                between[larger][other] += value
                between[other][larger] += value
            del between[other][smaller]
    parts = [tuple(sorted(members)) for members in groups.members.values()]
    return sorted(parts, key=lambda members: (-len(members), members))


def split_attempt(attempt: Attempt, run: RunContext) -> list[Attempt]:
    """Divide a model where more matches contradict than support its joins; small parts are left out."""
    if not run.settings.scene.tries("splits"):
        return [attempt]
    parts = sound_parts(attempt.explained, posed_photo_ids(attempt.model))
    if len(parts) == 1:
        return [attempt]
    large = [part for number, part in enumerate(parts) if len(part) >= (2 if number == 0 else MAPPING.min_photos)]
    with translate_errors("dividing a model"):
        return [part_of(attempt, part) for part in large]


def part_of(attempt: Attempt, photos: Iterable[int]) -> Attempt:
    """Return an attempt with only the given photos."""
    members = set(photos)
    explained = {pair: pair_support for pair, pair_support in attempt.explained.items() if members.issuperset(pair)}
    return replace(attempt, model=submodel(attempt.model, members), explained=explained)


# Loose scales. The relative scale of a third photo comes from points that all three see. Where a part shares hardly any
# of them with the rest, its points may fit well and its scale still be wrong.


def weakly_joined_parts(model: Reconstruction) -> list[list[str]]:
    """Return the names of photos in parts whose scale depends on too few points, as photos join by most points."""
    from scipy.sparse import csr_array

    with translate_errors("reading points"):
        names = {image.image_id: image.name for image in posed_images(model)}
        tracks = [{element.image_id for element in point.track.elements} for _, point in all_points(model)]
    photos = sorted(names)
    place = {photo: k for k, photo in enumerate(photos)}
    columns = [place[photo] for track in tracks for photo in sorted(track)]
    ends = np.cumsum([0, *map(len, tracks)])
    visibility = csr_array((np.ones(len(columns), np.int32), columns, ends), shape=(len(tracks), len(photos)))
    parts: list[list[str]] = [[]]
    for photo, known in _joining_order(visibility):
        if known < OPTIONS.min_common_points:
            parts.append([])
        parts[-1].append(names[photos[photo]])
    return [sorted(part) for part in parts[1:]]


def _joining_order(visibility: "csr_array") -> list[tuple[int, int]]:
    """Return the photos from the third on in joining order, each with its number of shared points."""
    from scipy.sparse import csr_array, triu

    points, photos = visibility.shape
    if photos < 3 or points == 0:
        return []
    by_photo = visibility.T.tocsr()
    together = csr_array(triu(by_photo @ visibility, k=1)).tocoo()
    i, j = together.coords
    best = np.lexsort((j, i, -together.data))[:1]
    # by point, the joined photos that see it; by photo, the points that it and two joined photos see
    views, known = np.zeros(points, np.int64), np.zeros(photos, np.int64)
    remaining, joined = np.ones(photos, np.bool_), list[tuple[int, int]]()
    pair = [int(photo) for photo in (*i[best], *j[best])] or [0, 1]
    while len(joined) < photos:
        photo = pair[len(joined)] if len(joined) < 2 else int(np.argmax(np.where(remaining, known, -1)))
        joined.append((photo, int(known[photo])))
        remaining[photo] = False
        own = by_photo.indices[by_photo.indptr[photo] : by_photo.indptr[photo + 1]]
        views[own] += 1
        known += np.bincount(visibility[own[views[own] == 2]].indices, minlength=photos)
    return joined[2:]
