"""Pairs of look-alikes that hold one place of a model on top of another.

Photos of two places that a model merges should overlap, but share nothing. Such photos belong on different sides. The
pairs that hold the sides together, the least cut between them, are wrong.
"""

import logging
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush
from itertools import chain, pairwise

import numpy as np

from sfm_app.colmap.backend import Camera, Reconstruction, all_points, translate_errors
from sfm_app.colmap.model import focal_px, posed_images
from sfm_app.errors import BackendError
from sfm_app.mapping.attempt import Attempt, PairSupport, saturate
from sfm_app.mapping.splits import OPTIONS as SPLIT
from sfm_app.numerical import FAILURES, Json
from sfm_app.posegraph.graph import LOOKS_ALIKE
from sfm_app.posegraph.look_alikes import OPTIONS as LOOK_ALIKES
from sfm_app.posegraph.look_alikes import cell_numbers, group_doubted_pairs, is_matched_again, is_well_inside
from sfm_app.posegraph.rotations import find_cut, partners_of
from sfm_app.types import Evidence, LookAlikes, MatchGraph, PairId, PoseGraph
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

# Recognized look-alikes: their matches are hidden from mapping, and reported.


class JUMPS:
    """Jumps in the order of photos. Chosen by hand."""

    min_photos: int = 30
    """Number of photos below which their order is no evidence."""
    jump: float = 5.0
    """Length of a jump, in median steps."""
    apart: float = 3.0
    """Difference of the numbers of two photos, in median differences, above which the second starts a series."""
    max_share: float = 0.1
    """Share of jumps above which photos count as unordered."""


def joined_pairs(joins: Iterable[LookAlikes]) -> set[PairId]:
    """Return the pairs of false joins."""
    return {pair for join in joins for pair in join.pairs}


def with_earlier_look_alikes(graph: PoseGraph, earlier: PoseGraph) -> PoseGraph:
    """Add the look-alikes of the graph of an earlier pass to a pose graph."""
    dropped = {pair: earlier.dropped[pair] for join in earlier.look_alikes for pair in join.pairs}
    return replace(graph, dropped=dropped | dict(graph.dropped), look_alikes=earlier.look_alikes + graph.look_alikes)


def with_false_joins(graph: PoseGraph, joins: Sequence[LookAlikes]) -> PoseGraph:
    """Return a pose graph without the pairs that merge two places of its model."""
    dropped = {pair for join in joins for pair in join.pairs}
    poses = {pair: pose for pair, pose in graph.poses.items() if pair not in dropped}
    return replace(
        graph,
        poses=poses,
        dropped=dict(graph.dropped) | dict.fromkeys(sorted(dropped), LOOKS_ALIKE),
        look_alikes=(*graph.look_alikes, *joins),
    )


def look_alike_entries(joins: Sequence[LookAlikes], matches: MatchGraph) -> list[dict[str, Json]]:
    """Return the recognized look-alikes as plain values for the manifest."""
    return [
        {
            "pairs": len(join.pairs),
            "between": [matches.names(photos) for photos in sides(join.pairs, matches)],
            "missing": round(join.missing, 3),
        }
        for join in joins
    ]


def jumps(model: Reconstruction) -> list[list[str]]:
    """Return successive photos of a numbered series that are much farther apart than others; empty if many steps are.

    Numbers that are much farther apart than others start another series, perhaps elsewhere.
    """
    with translate_errors("reading poses"):
        centers = {image.name: image.projection_center() for image in posed_images(model)}
    if len(centers) < JUMPS.min_photos:
        return []
    numbered = sorted((*_series(name), name) for name in centers)
    names = [name for *_, name in numbered]
    steps = np.linalg.norm(np.diff([centers[name] for name in names], axis=0), axis=1)
    apart = np.array([b[1] - a[1] if a[0] == b[0] else np.inf for a, b in pairwise(numbered)])
    long = (steps > JUMPS.jump * np.median(steps)) & np.isfinite(apart) & (apart <= JUMPS.apart * np.median(apart))
    if np.count_nonzero(long) > JUMPS.max_share * len(steps):
        return []
    return [[names[k], names[k + 1]] for k in np.flatnonzero(long)]


def _series(name: str) -> tuple[str, int]:
    """Return a photo's name without its last number, and that number; 0 where it has none."""
    parts = re.split(r"(\d+)(?=\D*$)", name, maxsplit=1, flags=re.ASCII)
    return (f"{parts[0]}*{parts[2]}", int(parts[1])) if len(parts) > 1 else (name, 0)


def sides(pairs: Sequence[PairId], matches: MatchGraph) -> tuple[list[int], list[int]]:
    """Return the photos at either place: each pair, the strongest first, puts its photos on opposite sides."""
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


# Expected overlaps. A street on top of another one fits all matches. Missing matches reveal it: photos of both streets
# stand at the same place, look the same way, and share no point (Zach et al. 2010, Heinly et al. 2014).


class OVERLAPS:
    """Expected overlaps of photos, and false joins; docs/algorithms/look-alikes.md."""

    candidates: int = 40
    """Photos nearby that a photo is compared with. Chosen by hand."""
    max_angle_deg: float = 45.0
    """Largest angle between the mean viewing rays of compared photos. Chosen by hand."""
    min_witnesses: int = 3
    """Photos with a point before another one is expected to have it: two may agree by chance. By definition."""
    behind: float = 1.1
    """Points farther away than others in a cell, by this factor, may be hidden. Chosen by hand."""
    max_shared: float = 0.1
    """Share of the expected cells up to which photos without matches do not overlap. Chosen by hand."""
    below_usual: float = 0.5
    """Photos do not overlap, either, if their share is lower than the median by this. Chosen by hand; right models of
    real photos stay above the median less 0.3, photos of a symmetric object on its wrong side below it less 0.5."""
    pulling_share: float = 0.7
    """Share of the expected cells from which photos are on one side. Chosen by hand."""
    min_pairs: int = 10
    """Non-overlapping pairs that prove a false join. Chosen by hand."""
    min_photos: int = 3
    """Photos on either side of a false join. Chosen by hand."""
    min_own_share: float = 0.35
    """Share of the expected cells below which a photo may be misplaced. Measured: right photos of 15 real sets have
    0.45 or more, those on the wrong side of lego50 0.28 or less, the most blurred of rendered ones 0.28."""
    min_agreeing: float = 0.9
    """Share of its inliers that agree with points above which it is not. Measured: the former have 0.87 and less, the
    latter 1."""
    max_passes: int = 3
    """Times that photos are mapped again without more look-alikes. Chosen by hand."""
    min_missing: float = 0.5
    """Share of the expected cells across a false join that must be missing. Chosen by hand."""
    usual_percentile: float = 90.0
    """Of the shares of pairs, those within one of several equal sides. Chosen by hand."""
    side_margin: float = 0.1
    """Photos are on one side from this share less this. Chosen by hand."""
    min_judged: int = 10
    """Photos with enough neighbors across that prove equal sides. Chosen by hand."""
    missing_ratio: float = 5.0
    """Missing cells across equal sides, in those within. Measured: folded models of oats23 and a palace have 5.7 and
    6.7, 60 right ones at most 3.8, parts of kitchen1000 4.4."""
    least_missing: float = 0.02
    """Share of missing cells within sides that always counts. Measured: right models have 0.002 to 0.043."""


@dataclass(frozen=True, slots=True)
class ExpectedOverlap:
    """Two photos that see the same place if the model is right."""

    expected: int
    """Cells of either photo in which points of the other one should be seen."""
    shared: int
    """Cells of these with a point of both."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedPhotoPoints:
    """A posed photo and its points."""

    camera: Camera
    focal_px: float
    pose: FloatArray
    """(3, 4) camera from world."""
    center: FloatArray
    rows: IndexArray
    """(N,) numbers of its points, ascending."""
    reach: FloatArray
    """By cell, median distance of its points; -1 without points."""
    witnessed: IndexArray
    """(M,) numbers of its points with enough witnesses."""
    rays: FloatArray
    """(M, 3) from its center to them, of length 1."""
    distances: FloatArray
    """(M,) from its center to them."""

    def rows_alike(self, there: "PosedPhotoPoints", points: FloatArray) -> IndexArray:
        """Return the numbers of its points with enough witnesses that look alike from another photo."""
        rays = points[self.witnessed] - there.center
        lengths = np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
        size_ratios = lengths / self.distances * self.focal_px / there.focal_px
        return self.witnessed[is_matched_again(size_ratios, (self.rays * rays).sum(axis=1) / lengths)]


def find_expected_overlaps(model: Reconstruction) -> dict[PairId, ExpectedOverlap]:
    """Return by pair the overlap of photos that stand side by side and look the same way."""
    with translate_errors("reading points"):
        return _expected_overlaps(*_read_posed_photos(model))


def _expected_overlaps(points: FloatArray, photos: Mapping[int, PosedPhotoPoints]) -> dict[PairId, ExpectedOverlap]:
    counts: dict[PairId, list[int]] = {}
    for photo, other in _neighbors(photos):
        there = photos[other]
        expected, shared = _compare(photos[photo].rows_alike(there, points), there, points)
        if expected >= LOOK_ALIKES.min_cells:
            sums = counts.setdefault((min(photo, other), max(photo, other)), [0, 0])
            sums[0] += expected
            sums[1] += shared
    return {pair: ExpectedOverlap(*sums) for pair, sums in sorted(counts.items())}


def _read_posed_photos(model: Reconstruction) -> tuple[FloatArray, dict[int, PosedPhotoPoints]]:
    """Return the points (P, 3) of a model, and by id its posed photos with points of enough witnesses."""
    stored = sorted(all_points(model), key=lambda item: item[0])
    points = np.array([point.xyz for _, point in stored], np.float64).reshape(-1, 3)
    often = np.array([point.track.length() >= OVERLAPS.min_witnesses for _, point in stored], np.bool_)
    keys, photos = np.array([key for key, _ in stored], np.int64), {}
    for image in posed_images(model):
        observations = image.get_observation_points2D()
        rows, first = np.unique(np.searchsorted(keys, [one.point3D_id for one in observations]), return_index=True)
        if often[rows].any():
            x = np.array([one.xy for one in observations], np.float64)[first]
            photos[image.image_id] = _posed_photo_points(model, image.image_id, rows, x, points, often[rows])
    return points, photos


def _posed_photo_points(
    model: Reconstruction, photo: int, rows: IndexArray, x: FloatArray, points: FloatArray, often: BoolArray
) -> PosedPhotoPoints:
    """Return a photo with its points: rows (N,) at pixels x (N, 2), and a mask of those with enough witnesses."""
    image = model.images[photo]
    camera = model.cameras[image.camera_id]
    center = np.asarray(image.projection_center(), np.float64)
    rays = points[rows] - center
    distances = np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
    cells = cell_numbers(x, camera.width, camera.height)
    return PosedPhotoPoints(
        camera, focal_px(model, photo), np.asarray(image.cam_from_world().matrix()), center, rows,
        _cell_medians(distances, cells), rows[often], (rays / distances[:, None])[often], distances[often],
    )  # fmt: skip


def _cell_medians(distances: FloatArray, cells: IndexArray) -> FloatArray:
    """Return by cell the median of the distances (N,) in it; -1 without any."""
    medians = np.full((LOOK_ALIKES.cells + 1) ** 2, -1.0)
    for cell in np.unique(cells):
        medians[cell] = np.median(distances[cells == cell])
    return medians


def _neighbors(posed: Mapping[int, PosedPhotoPoints]) -> Iterator[PairId]:
    from scipy.spatial import KDTree

    if not posed:
        return
    photos, posed_photos = list(posed), list(posed.values())
    tree = KDTree(np.array([here.center for here in posed_photos]))
    directions = np.array([here.rays.mean(axis=0) for here in posed_photos])
    directions /= np.maximum(np.linalg.norm(directions, axis=1), 1e-12)[:, None]
    for number, here in enumerate(posed_photos):
        nearby = np.array(sorted(tree.query_ball_point(here.center, float(np.median(here.distances)))), np.int64)
        nearby = nearby[
            (directions[nearby] @ directions[number] > np.cos(np.radians(OVERLAPS.max_angle_deg))) & (nearby != number)
        ]
        chosen = nearby[np.unique(np.linspace(0, len(nearby) - 1, min(OVERLAPS.candidates, len(nearby))).astype(int))]
        yield from ((photos[number], photos[other]) for other in chosen)


def _compare(rows: IndexArray, there: PosedPhotoPoints, points: FloatArray) -> tuple[int, int]:
    """Count the cells of a photo that should show points `rows` of others, and those of them that do."""
    rows, cells, distances = _expected_points(rows, there, points)
    is_visible = distances < OVERLAPS.behind * there.reach[cells]
    expected, shared = _shared_cells(rows[is_visible], cells[is_visible], there)
    return len(expected), int(np.count_nonzero(shared))


def _expected_points(
    rows: IndexArray, there: PosedPhotoPoints, points: FloatArray
) -> tuple[IndexArray, IndexArray, FloatArray]:
    """Return those of points `rows` that project into a photo, their cells, and their distances from its center."""
    inside = points[rows] @ there.pose[:, :3].T + there.pose[:, 3]
    x = np.asarray(there.camera.img_from_cam(inside), np.float64).reshape(-1, 2)
    is_inside = is_well_inside(x, there.camera.width, there.camera.height)
    cells = cell_numbers(x[is_inside], there.camera.width, there.camera.height)
    return rows[is_inside], cells, np.linalg.norm(inside[is_inside], axis=1)


def _shared_cells(rows: IndexArray, cells: IndexArray, there: PosedPhotoPoints) -> tuple[IndexArray, BoolArray]:
    """Return the cells with enough of the expected points `rows`, and a mask of those where the photo has one."""
    expected, counts = np.unique(cells, return_counts=True)
    expected = expected[counts >= LOOK_ALIKES.min_cell_points]
    return expected, np.isin(expected, cells[np.isin(rows, there.rows, assume_unique=True)])


# A photo on the wrong side of a symmetric object: few matches fit there, others contradict them, and most of what
# its neighbors see is missing in it. A blurred photo in its place misses as much, but nothing contradicts it.


def find_misplaced(model: Reconstruction, evidence: Evidence, max_error_px: float) -> dict[int, float]:
    """Return the photos that lack most expected points and that inliers contradict, with the missing share, 0 to 1."""
    with translate_errors("reading points"):
        points, photos = _read_posed_photos(model)
        neighbors, keypoints, misplaced = partners_of(_neighbors(photos)), evidence.matches.keypoints, {}
        for photo, there in photos.items():
            alike = [photos[other].rows_alike(there, points) for other in neighbors.get(photo, ())]
            share = _own_share(there, alike, points, keypoints[photo]) if alike else 1.0
            if share >= OVERLAPS.min_own_share:
                continue
            if _agreeing_share(photo, model, evidence, max_error_px) < OVERLAPS.min_agreeing:
                misplaced[photo] = 1.0 - share
        return misplaced


def _own_share(
    there: PosedPhotoPoints, alike: Sequence[IndexArray], points: FloatArray, keypoints: FloatArray
) -> float:
    """Return the share of the expected cells in which a photo has an expected point; 1 where it has few such cells.

    Cells with points of its neighbors and with features of its own, at pixels (K, 2), are expected.
    """
    rows, cells, distances = _expected_points(np.unique(np.concatenate(alike)), there, points)
    medians, width, height = _cell_medians(distances, cells), there.camera.width, there.camera.height
    own = cell_numbers(keypoints.clip(0.0, [width - 1, height - 1]), width, height)
    featured = np.bincount(own, minlength=len(medians)) >= LOOK_ALIKES.min_cell_points
    is_visible = (distances < OVERLAPS.behind * medians[cells]) & featured[cells]
    expected, shared = _shared_cells(rows[is_visible], cells[is_visible], there)
    return float(shared.mean()) if len(expected) >= LOOK_ALIKES.min_cells else 1.0


def _agreeing_share(photo: int, model: Reconstruction, evidence: Evidence, max_error_px: float) -> float:
    """Return the share of the inliers of a photo that lie where the points of their partners project; 1 without any."""
    matches, rows, X = evidence.matches, list[int](), list[FloatArray]()
    posed = {image.image_id: image for image in posed_images(model)}
    for pair, fit in evidence.views.fits.items():
        if photo in pair and posed.keys() >= set(pair):
            here = pair.index(photo)
            others = posed[pair[1 - here]].points2D
            for match in matches.matches[pair][fit.inliers]:
                partner = others[match[1 - here]]
                if partner.has_point3D():
                    rows.append(match[here])
                    X.append(model.points3D[partner.point3D_id].xyz)
    pose = posed[photo].cam_from_world().matrix()
    inside = np.array(X, np.float64).reshape(-1, 3) @ pose[:, :3].T + pose[:, 3]
    camera = model.cameras[posed[photo].camera_id]
    errors = np.asarray(camera.img_from_cam(inside), np.float64).reshape(-1, 2) - matches.keypoints[photo][rows]
    return float(np.mean(np.linalg.norm(errors, axis=1) < max_error_px)) if rows else 1.0


logger = logging.getLogger("sfm_app")


def judge_places(models: Iterable[Attempt]) -> tuple[list[LookAlikes], int]:
    """Return the false joins of models, and their number of non-overlapping pairs."""
    joins, non_overlapping = list[LookAlikes](), 0
    for attempt in models:
        try:
            with translate_errors("reading points"):
                points, photos = _read_posed_photos(attempt.model)
                overlaps = _expected_overlaps(points, photos)
                equal_sides = find_equal_sides(overlaps, points, photos)
            joins += find_false_joins(overlaps, attempt.explained, equal_sides)
        except (*FAILURES, BackendError) as err:  # the model itself is there
            logger.info("the places of model %s could not be checked", attempt.note, exc_info=err)
            continue
        non_overlapping += len(find_non_overlapping(overlaps, attempt.explained))
        non_overlapping += sum(len(_split_pairs(overlaps, sides)[1]) for sides in equal_sides)
    return joins, non_overlapping


def find_non_overlapping(
    overlaps: Mapping[PairId, ExpectedOverlap], explained: Mapping[PairId, PairSupport]
) -> dict[PairId, ExpectedOverlap]:
    """Return the pairs of photos that should overlap, and share next to nothing, or far less than other pairs do."""
    usual = float(np.median([one.shared / one.expected for one in overlaps.values()])) if overlaps else 0.0
    return {
        pair: one for pair, one in overlaps.items()
        if one.shared < (usual - OVERLAPS.below_usual) * one.expected
        or (one.shared <= OVERLAPS.max_shared * one.expected and not _is_significant(explained.get(pair)))
    }  # fmt: skip


# Equal sides. Where photos of all sides of a palace are on one side of the model, facades match, and what surrounds
# them does not. Photos at the ends of a loop, too, may lack points of each other, but not the same ones of all others.


def find_equal_sides(
    overlaps: Mapping[PairId, ExpectedOverlap], points: FloatArray, photos: Mapping[int, PosedPhotoPoints]
) -> list[dict[int, int]]:
    """Return divisions of the photos, 1 or -1 by photo, where far more is missing across than within the sides."""
    divisions, waiting = list[dict[int, int]](), [dict(overlaps)]
    shares = [one.shared / one.expected for one in overlaps.values()]
    pulling = float(np.percentile(shares, OVERLAPS.usual_percentile)) - OVERLAPS.side_margin if shares else 0.0
    while waiting:
        group = waiting.pop()
        if all(_affinity(one, pulling) >= 0 for one in group.values()):
            continue
        sides = _assign_sides(group, group, pulling)
        within, across = _split_pairs(group, sides)
        usual, between = (_compare_with_all(pairs, points, photos) for pairs in (within, across))
        most = OVERLAPS.missing_ratio * max(_missing_share(usual), OVERLAPS.least_missing)
        if len(between) >= OVERLAPS.min_judged and _missing_share(between) >= most:
            divisions.append(sides)
            waiting += [{pair: group[pair] for pair in within if sides[pair[0]] == side} for side in (1, -1)]
    return divisions


def _split_pairs(pairs: Iterable[PairId], sides: Mapping[int, int]) -> tuple[list[PairId], list[PairId]]:
    """Return the pairs within the sides, and those across; without pairs of photos that have no side."""
    known = [pair for pair in pairs if sides.keys() >= set(pair)]
    return [(a, b) for a, b in known if sides[a] == sides[b]], [(a, b) for a, b in known if sides[a] != sides[b]]


def _compare_with_all(
    pairs: Iterable[PairId], points: FloatArray, photos: Mapping[int, PosedPhotoPoints]
) -> list[ExpectedOverlap]:
    """Return the overlap of each photo with the points of all its partners; without photos of few partners."""
    found = []
    for photo, others in partners_of(pairs).items():
        if len(others) >= OVERLAPS.min_witnesses:
            there = photos[photo]
            rows = np.unique(np.concatenate([photos[other].rows_alike(there, points) for other in sorted(others)]))
            found.append(ExpectedOverlap(*_compare(rows, there, points)))
    return [one for one in found if one.expected >= LOOK_ALIKES.min_cells]


def find_false_joins(
    overlaps: Mapping[PairId, ExpectedOverlap], explained: Mapping[PairId, PairSupport],
    equal_sides: Iterable[Mapping[int, int]] = (),
) -> list[LookAlikes]:  # fmt: skip
    """Return the pairs that hold non-overlapping photos or equal sides together, each false join by itself."""
    non_overlapping, joins = find_non_overlapping(overlaps, explained), list[LookAlikes]()
    significant = {pair: one.matches for pair, one in explained.items() if _is_significant(one)}
    strengths = dict(zip(significant, saturate(list(significant.values())).tolist(), strict=True))
    photos, remaining = sorted(set(chain(*significant, *overlaps))), dict(non_overlapping)

    def separate(here: Mapping[int, bool], missing: float) -> None:
        pairs = {pair for pair in strengths if here[pair[0]] != here[pair[1]]}
        for pair in pairs:
            del strengths[pair]
        joins.extend(LookAlikes(join, missing) for join in group_doubted_pairs(pairs, strengths))

    while len(remaining) >= OVERLAPS.min_pairs:
        sides = _assign_sides(remaining, overlaps, OVERLAPS.pulling_share)
        apart = {
            pair for pair in _split_pairs(overlaps, sides)[1] if _affinity(overlaps[pair], OVERLAPS.pulling_share) < 0
        }
        here = _cut_sides({photo: sides[photo] for photo in chain(*apart)}, photos, strengths)
        across = {pair: one for pair, one in overlaps.items() if {here.get(photo) for photo in pair} == {True, False}}
        missing = _missing_share(across.values())
        if len(across.keys() & non_overlapping.keys()) >= OVERLAPS.min_pairs and missing >= OVERLAPS.min_missing:
            separate(here, missing)
        remaining = {pair: remaining[pair] for pair in _split_pairs(remaining, sides)[0]}
    for division in equal_sides:
        if here := _cut_sides(division, photos, strengths):
            separate(here, _missing_share([overlaps[pair] for pair in _split_pairs(overlaps, division)[1]]))
    return joins


def _missing_share(overlaps: Collection[ExpectedOverlap]) -> float:
    return 1.0 - sum(one.shared for one in overlaps) / max(sum(one.expected for one in overlaps), 1)


def _is_significant(pair: PairSupport | None) -> bool:
    return pair is not None and pair.matches >= SPLIT.min_matches


def _affinity(overlap: ExpectedOverlap, pulling_share: float) -> float:
    """Return how many cells speak for one place, less those that speak for two."""
    return overlap.shared - pulling_share * overlap.expected


def _assign_sides(
    apart: Iterable[PairId], overlaps: Mapping[PairId, ExpectedOverlap], pulling_share: float
) -> dict[int, int]:
    """Return the side, 1 or -1, of all photos with overlaps, the surest first."""
    affinities: dict[int, dict[int, float]] = {photo: {} for photo in chain(*overlaps)}
    for (a, b), one in overlaps.items():
        affinities[a][b] = affinities[b][a] = _affinity(one, pulling_share)
    seed = min(apart, key=lambda pair: (affinities[pair[0]][pair[1]], pair))
    sides, votes = dict[int, int](), dict.fromkeys(sorted(affinities), 0.0)
    waiting = [(-np.inf, seed[0], np.inf), (-np.inf, seed[1], -np.inf), *((0.0, photo, 0.0) for photo in votes)]
    heapify(waiting)
    while waiting:
        _, photo, vote = heappop(waiting)
        if photo in sides or (np.isfinite(vote) and vote != votes[photo]):
            continue
        sides[photo] = 1 if vote >= 0 else -1
        for other, affinity in affinities[photo].items():
            if other not in sides:
                votes[other] += sides[photo] * affinity
                heappush(waiting, (-abs(votes[other]), other, votes[other]))
    return sides


def _cut_sides(sides: Mapping[int, int], photos: Sequence[int], strengths: Mapping[PairId, float]) -> dict[int, bool]:
    """Return for each photo on which side of the least cut it is; empty where there is nothing to cut."""
    number = {photo: k for k, photo in enumerate(photos)}
    ends = [np.array([number[one] for one, side in sides.items() if side == which], np.int64) for which in (1, -1)]
    if min(map(len, ends)) < OVERLAPS.min_photos:
        return {}
    edges = np.array([[number[photo] for photo in pair] for pair in strengths], np.int64).reshape(-1, 2)
    here, weight = find_cut(len(photos), edges, np.array(list(strengths.values())), (ends[0], ends[1]))
    return dict(zip(photos, here.tolist(), strict=True)) if 0.0 < weight < np.inf else {}
