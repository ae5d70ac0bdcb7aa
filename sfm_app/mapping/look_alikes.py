"""Pairs of look-alikes that hold one place of a model on top of another.

Photos of two places that a model has in one are strangers: they should share most of what they see, and share nothing.
Strangers belong on different sides. The pairs that hold the sides together, the least cut between them, are wrong.
"""

import logging
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush
from itertools import chain

import numpy as np
from scipy.spatial import KDTree

from sfm_app.colmap.backend import Camera, Reconstruction, all_points, translate_errors
from sfm_app.colmap.model import focal_px, posed_images
from sfm_app.errors import BackendError
from sfm_app.mapping.attempt import Attempt, PairSupport, photo_names, saturate
from sfm_app.mapping.split_and_merge import LEAST_MATCHES
from sfm_app.numerical import FAILURES, Json
from sfm_app.posegraph.graph import LOOKS_ALIKE
from sfm_app.posegraph.look_alikes import (
    CELLS,
    LEAST_CELLS,
    MIN_CELL_POINTS,
    cell_numbers,
    group_doubted_pairs,
    is_matched_again,
    is_well_inside,
)
from sfm_app.posegraph.rotations import find_cut
from sfm_app.types import LookAlikes, MatchGraph, PairId, PoseGraph, ViewGraph
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

# Look-alikes that were recognized: hide their matches from mapping, and report them.

LEAST_IN_ORDER = 30
"""Number of photos below which their order is no evidence: temple16 is numbered in two arcs."""
JUMP, MOST_JUMPS = 5.0, 0.1
"""Length of a jump, in median steps; with a larger share of jumps the photos count as unordered. Not chosen on any set;
the usual order of castle-P19, fountain-P11, Herz-Jesus-P8, kitti51 and oats23 has no jump."""


def drop_look_alikes(matches: MatchGraph, views: ViewGraph, graph: PoseGraph) -> tuple[MatchGraph, ViewGraph]:
    """Return matches and fundamental matrices without those of look-alikes.

    Pairs of look-alikes are evidence neither for a model nor against it.

    Args:
        matches: keypoints and raw matches.
        views: fundamental matrices.
        graph: knows the pairs of look-alikes.
    """
    gone = {pair for join in graph.look_alikes for pair in join.pairs}
    if not gone:
        return matches, views
    kept = {pair: rows for pair, rows in matches.matches.items() if pair not in gone}
    fits = {pair: fit for pair, fit in views.fits.items() if pair not in gone}
    return replace(matches, matches=kept), replace(views, fits=fits)


def with_earlier_look_alikes(graph: PoseGraph, earlier: PoseGraph) -> PoseGraph:
    """Return a pose graph with the look-alikes of an earlier pass added to its own.

    Args:
        graph: pose graph of this pass.
        earlier: pose graph of the pass before it.
    """
    dropped = {pair: earlier.dropped[pair] for join in earlier.look_alikes for pair in join.pairs}
    return replace(graph, dropped=dropped | dict(graph.dropped), look_alikes=earlier.look_alikes + graph.look_alikes)


def with_false_joins(graph: PoseGraph, joins: Sequence[LookAlikes]) -> PoseGraph:
    """Return a pose graph without the pairs of look-alikes that a model showed.

    Args:
        graph: pose graph of the pass that made the model.
        joins: pairs that hold one place on top of another.
    """
    gone = {pair for join in joins for pair in join.pairs}
    kept = {pair: pose for pair, pose in graph.poses.items() if pair not in gone}
    return replace(
        graph,
        poses=kept,
        dropped=dict(graph.dropped) | dict.fromkeys(sorted(gone), LOOKS_ALIKE),
        look_alikes=(*graph.look_alikes, *joins),
    )


def look_alike_entries(joins: Sequence[LookAlikes], matches: MatchGraph) -> list[dict[str, Json]]:
    """Return the recognized look-alikes, for the manifest.

    Args:
        joins: pairs of look-alikes, grouped by the places that they confuse.
        matches: knows the photos' names.
    """
    return [
        {
            "pairs": len(join.pairs),
            "between": [photo_names(photos, matches) for photos in sides(join.pairs, matches)],
            "missing": round(join.missing, 3),
        }
        for join in joins
    ]


def jumps(model: Reconstruction) -> list[list[str]]:
    """Return successive photos, by name, that are much farther apart than others: a video may be folded there.

    Empty where many steps are long, because the photos are then unordered. A jump is no proof: videos may be cut, too.
    """
    with translate_errors("reading poses"):
        placed = sorted((image.name, image.projection_center()) for image in posed_images(model))
    if len(placed) < LEAST_IN_ORDER:
        return []
    steps = np.linalg.norm(np.diff([center for _, center in placed], axis=0), axis=1)
    long = np.flatnonzero(steps > JUMP * np.median(steps))
    return [[placed[k][0], placed[k + 1][0]] for k in long] if len(long) <= MOST_JUMPS * len(steps) else []


def sides(pairs: Sequence[PairId], matches: MatchGraph) -> tuple[list[int], list[int]]:
    """Return the photos at either place: each pair, those with most matches first, puts its photos on opposite sides.

    Args:
        pairs: look-alikes; at least one.
        matches: raw matches of these pairs.
    """
    counts = {pair: len(matches.matches[pair]) for pair in pairs}
    here: set[int] = set()
    there: set[int] = set()
    waiting = sorted(pairs, key=lambda pair: (-counts[pair], pair))
    while waiting:
        known = here | there
        a, b = next((pair for pair in waiting if not known.isdisjoint(pair)), waiting[0])
        waiting.remove((a, b))
        if a in there or b in here:
            a, b = b, a
        if a not in known:
            here.add(a)
        if b not in known:
            there.add(b)
    return sorted(here), sorted(there)


# Photos that see the same place if their model is right, and what they have in common.
#
# A street that a look-alike holds on top of another one fits all matches that were found. What gives it away is
# what was not found: photos of both streets stand at the same place, look the same way, and share no point (Zach et
# al. 2010, Heinly et al. 2014 look for such missing matches between pairs of photos).

CANDIDATES = 40
"""Photos nearby with which a photo may meet. Chosen by hand."""
MOST_TURN_DEG = 45.0
"""Largest angle between the mean viewing rays of photos that are compared. Chosen by hand."""
LEAST_WITNESSES = 3
"""Photos that have to see a point before another one is expected to: two may agree by chance."""
LEAST_DISTANCE = 1e-12
"""Distances are at least this, so that they divide."""
BEHIND = 1.1
"""Points farther away than what a photo sees in a cell, by this factor, may be hidden. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class Meeting:
    """Two photos that see the same place if the model is right."""

    expected: int
    """Cells of either photo in which points of the other one should be seen."""
    shared: int
    """Of these, cells in which a point of both is."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A posed photo and the points that it sees."""

    camera: Camera
    focal_px: float
    pose: FloatArray
    """(3, 4) camera from world."""
    center: FloatArray
    rows: IndexArray
    """(N,) numbers of its points, ascending."""
    reach: FloatArray
    """By cell, how far away what it sees there is; -1 where it sees nothing."""
    firm: IndexArray
    """(M,) numbers of the points that others see, too."""
    rays: FloatArray
    """(M, 3) from its center to them, of length 1."""
    distances: FloatArray
    """(M,) from its center to them."""


def find_meetings(model: Reconstruction) -> dict[PairId, Meeting]:
    """Return by pair what photos that stand side by side and look the same way have in common.

    Args:
        model: with poses and points.
    """
    with translate_errors("reading points"):
        points, sights = _read_sights(model)
        found: dict[PairId, list[int]] = {}
        for photo, other in _neighbors(sights):
            expected, shared = _compare(sights[photo], sights[other], points)
            if expected >= LEAST_CELLS:
                sums = found.setdefault((min(photo, other), max(photo, other)), [0, 0])
                sums[0] += expected
                sums[1] += shared
    return {pair: Meeting(*sums) for pair, sums in sorted(found.items())}


def _read_sights(model: Reconstruction) -> tuple[FloatArray, dict[int, Sight]]:
    """Return the points (P, 3) of a model, and by id its posed photos that see points which others see, too."""
    stored = sorted(all_points(model), key=lambda item: item[0])
    points = np.array([point.xyz for _, point in stored], np.float64).reshape(-1, 3)
    often = np.array([point.track.length() >= LEAST_WITNESSES for _, point in stored], np.bool_)
    keys, found = np.array([key for key, _ in stored], np.int64), {}
    for image in posed_images(model):
        seen = image.get_observation_points2D()
        rows, first = np.unique(np.searchsorted(keys, [one.point3D_id for one in seen]), return_index=True)
        if often[rows].any():
            x = np.array([one.xy for one in seen], np.float64)[first]
            found[image.image_id] = _look(model, image.image_id, (rows, x), points, often[rows])
    return points, found


def _look(
    model: Reconstruction, photo: int, seen: tuple[IndexArray, FloatArray], points: FloatArray, often: BoolArray
) -> Sight:
    """Return what a photo sees: rows of points (N,) at pixels (N, 2), of which others often see some, too."""
    image = model.images[photo]
    camera, (rows, x) = model.cameras[image.camera_id], seen
    center = np.asarray(image.projection_center(), np.float64)
    rays = points[rows] - center
    distances = np.maximum(np.linalg.norm(rays, axis=1), LEAST_DISTANCE)
    cells = cell_numbers(x, camera.width, camera.height)
    reach = np.full((CELLS + 1) ** 2, -1.0)
    for cell in np.unique(cells):
        reach[cell] = np.median(distances[cells == cell])
    return Sight(
        camera, focal_px(model, photo), np.asarray(image.cam_from_world().matrix()), center, rows, reach,
        rows[often], (rays / distances[:, None])[often], distances[often],
    )  # fmt: skip


def _neighbors(sights: Mapping[int, Sight]) -> Iterator[PairId]:
    """Yield photos with others nearby that look the same way; some of these where there are many."""
    if not sights:
        return
    photos, seers = list(sights), list(sights.values())
    tree = KDTree(np.array([sight.center for sight in seers]))
    directions = np.array([sight.rays.mean(axis=0) for sight in seers])
    directions /= np.maximum(np.linalg.norm(directions, axis=1), LEAST_DISTANCE)[:, None]
    for number, sight in enumerate(seers):
        near = np.array(sorted(tree.query_ball_point(sight.center, float(np.median(sight.distances)))), np.int64)
        near = near[(directions[near] @ directions[number] > np.cos(np.radians(MOST_TURN_DEG))) & (near != number)]
        chosen = near[np.unique(np.linspace(0, len(near) - 1, min(CANDIDATES, len(near))).astype(np.int64))]
        yield from ((photos[number], photos[other]) for other in chosen)


def _compare(here: Sight, there: Sight, points: FloatArray) -> tuple[int, int]:
    """Count the cells of a photo in which it should see points of another one, and those in which it does."""
    away = points[here.firm] - there.center
    lengths = np.maximum(np.linalg.norm(away, axis=1), LEAST_DISTANCE)
    smaller = lengths / here.distances * here.focal_px / there.focal_px
    again = is_matched_again(smaller, (here.rays * away).sum(axis=1) / lengths)
    rows, lengths = here.firm[again], lengths[again]
    inside = points[rows] @ there.pose[:, :3].T + there.pose[:, 3]
    x = np.asarray(there.camera.img_from_cam(inside), np.float64).reshape(-1, 2)
    shown = is_well_inside(x, there.camera.width, there.camera.height)
    rows, cells = rows[shown], cell_numbers(x[shown], there.camera.width, there.camera.height)
    open_ = lengths[shown] < BEHIND * there.reach[cells]
    rows, cells = rows[open_], cells[open_]
    expected, counts = np.unique(cells, return_counts=True)
    expected = expected[counts >= MIN_CELL_POINTS]
    hit = cells[np.isin(rows, there.rows, assume_unique=True)]
    return len(expected), int(np.count_nonzero(np.isin(expected, hit)))


logger = logging.getLogger("sfm_app")

STRANGE_SHARE = 0.1
"""Photos that meet are strangers if they share at most this part of the cells that they should. docs/algorithms.md,
Overlaid places."""
PULLING_SHARE = 0.7
"""Share of the cells that they should share from which photos that meet are on one side. Chosen by hand: photos of one
place share more in 9 of 10 pairs of a video and in nearly all others, those of a house in two streets 0 to 0.65."""
LEAST_STRANGERS, LEAST_PHOTOS_OF_JOIN = 10, 3
"""Pairs of strangers, and photos on either side, that prove a wrong join. Chosen by hand."""
MOST_FALSE_JOINS = 3
"""Times that photos are mapped again without more look-alikes. Chosen by hand."""
LEAST_MISSING = 0.5
"""Least share of the cells that photos on either side of a false join should share, but do not. Chosen by hand: 0.88
for a house in two streets of a rendered town. Of 17 right models, no meeting of two photos misses more than 0.75."""


def judge_places(models: Iterable[Attempt]) -> tuple[list[LookAlikes], int]:
    """Return the false joins of models, and how many pairs of photos are strangers in them.

    Args:
        models: with the matches that they explain.
    """
    joins, strangers = list[LookAlikes](), 0
    for attempt in models:
        try:
            meetings = find_meetings(attempt.model)
            joins += find_false_joins(meetings, attempt.explained)
        except (*FAILURES, BackendError) as err:  # the model itself is there
            logger.info("places of the model %s were not judged", attempt.note, exc_info=err)
            continue
        strangers += len(find_strangers(meetings, attempt.explained))
    return joins, strangers


def find_strangers(
    meetings: Mapping[PairId, Meeting], explained: Mapping[PairId, PairSupport]
) -> dict[PairId, Meeting]:
    """Return the pairs of photos that should share most of what they see, and share next to nothing.

    Args:
        meetings: pairs of photos that see the same place in the model.
        explained: matches of each pair that the model explains.
    """
    return {
        pair: one for pair, one in meetings.items()
        if one.shared <= STRANGE_SHARE * one.expected and not _holds(explained.get(pair))
    }  # fmt: skip


def find_false_joins(meetings: Mapping[PairId, Meeting], explained: Mapping[PairId, PairSupport]) -> list[LookAlikes]:
    """Return the pairs that hold strangers together, those of each false join for themselves.

    Args:
        meetings, explained: as in `find_strangers`.
    """
    strangers, found = find_strangers(meetings, explained), list[LookAlikes]()
    holding = {pair: one.matches for pair, one in explained.items() if _holds(one)}
    strengths = dict(zip(holding, saturate(list(holding.values())).tolist(), strict=True))
    photos, left = sorted(set(chain(*holding, *meetings))), dict(strangers)
    while len(left) >= LEAST_STRANGERS:
        sides = _take_sides(left, meetings)
        apart = {pair for pair, one in meetings.items() if sides[pair[0]] != sides[pair[1]] and _pull(one) < 0}
        here = _divide({photo: sides[photo] for photo in chain(*apart)}, photos, strengths)
        across = {pair: one for pair, one in meetings.items() if {here.get(photo) for photo in pair} == {True, False}}
        missing = _missing_share(across.values())
        if len(across.keys() & strangers.keys()) >= LEAST_STRANGERS and missing >= LEAST_MISSING:
            pairs = {pair for pair in strengths if here[pair[0]] != here[pair[1]]}
            strengths = {pair: strength for pair, strength in strengths.items() if pair not in pairs}
            found += [LookAlikes(join, missing) for join in group_doubted_pairs(pairs, strengths)]
        left = {(a, b): one for (a, b), one in left.items() if sides[a] == sides[b]}
    return found


def _missing_share(meetings: Collection[Meeting]) -> float:
    expected = sum(one.expected for one in meetings)
    return 1.0 - sum(one.shared for one in meetings) / max(expected, 1)


def _holds(found: PairSupport | None) -> bool:
    return found is not None and found.matches >= LEAST_MATCHES


def _pull(meeting: Meeting) -> float:
    """Return how many cells speak for one place, less those that speak for two."""
    return meeting.shared - PULLING_SHARE * meeting.expected


def _take_sides(strangers: Mapping[PairId, Meeting], meetings: Mapping[PairId, Meeting]) -> dict[int, int]:
    """Return the side, 1 or -1, of all photos that meet others: the strangest pair first, then what is most certain.

    Those who share what they should pull a photo to their side, the others push it to the other one.
    """
    pulls: dict[int, dict[int, float]] = {photo: {} for photo in chain(*meetings)}
    for (a, b), one in meetings.items():
        pulls[a][b] = pulls[b][a] = _pull(one)
    seed = min(strangers, key=lambda pair: (-strangers[pair].expected, pair))
    sides, votes = dict[int, int](), dict.fromkeys(sorted(pulls), 0.0)
    waiting = [(-np.inf, seed[0], np.inf), (-np.inf, seed[1], -np.inf), *((0.0, photo, 0.0) for photo in votes)]
    heapify(waiting)
    while waiting:
        _, photo, vote = heappop(waiting)
        if photo in sides or (np.isfinite(vote) and vote != votes[photo]):
            continue
        sides[photo] = 1 if vote >= 0 else -1
        for other, pull in pulls[photo].items():
            if other not in sides:
                votes[other] += sides[photo] * pull
                heappush(waiting, (-abs(votes[other]), other, votes[other]))
    return sides


def _divide(sides: Mapping[int, int], photos: Sequence[int], strengths: Mapping[PairId, float]) -> dict[int, bool]:
    """Return for each photo on which side of the least cut it is; empty where there is nothing to cut."""
    number = {photo: k for k, photo in enumerate(photos)}
    ends = [np.array([number[one] for one, side in sides.items() if side == which], np.int64) for which in (1, -1)]
    if min(map(len, ends)) < LEAST_PHOTOS_OF_JOIN:
        return {}
    edges = np.array([[number[photo] for photo in pair] for pair in strengths], np.int64).reshape(-1, 2)
    here, weight = find_cut(len(photos), edges, np.array(list(strengths.values())), (ends[0], ends[1]))
    return dict(zip(photos, here.tolist(), strict=True)) if 0.0 < weight < np.inf else {}
