"""Detection of equal things in different places, before mapping.

Photos of two equal cans on a table have a relative pose as good as any, and its rotation may agree with the other
pairs. The path between the cans distinguishes them: along the pairs that share most of their content (`coverage`), the
points of the first can leave the view, and those of the second are new ones. Therefore

1. the pairs of the backbone join matches into tracks;
2. a pair with many matches on such tracks, but hardly any with both ends on the same track, contradicts the backbone:
   it closes a loop, or joins look-alikes;
3. such pairs between the same two places are judged together: if they were one place, the surroundings of the things
   would have matches, too (`missing`). In a loop they have.

Zach et al. 2010 and Heinly et al. 2014 test for missing matches; Wilson and Snavely 2013 and Yan et al. 2017 test how
tracks and paths of photos are connected. Both are needed: a wide baseline misses many matches, and a loop loses its
tracks.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from sfm_app.camera.bearings import bearings, depths_along, project
from sfm_app.geometry.epipolar import FIRST, SECOND, depths
from sfm_app.posegraph.rotations import DisjointGroups, average_rotations
from sfm_app.types import Calibration, LookAlikes, MatchGraph, PairId, RelativePose
from sfm_app.types.arrays import FloatArray, IndexArray

# The share of their content that two photos have in common, and the backbone of pairs that have most of it.
#
# Neighbors on a walk share most of what the rest of the set knows about either of them. Photos of equal things in
# different places share only the things, however many matches these give, and nothing around them.

CELLS = 12
"""Cells along the longer side of a photo. 16 give the same on oats23 and books21; with 24 one wrong pair enters the
backbone of oats23, and nothing is found there. docs/algorithms.md, Look-alikes."""
MIN_OTHER_PHOTOS = 2
"""A keypoint is known to the set if it has partners in this many photos besides that of the pair. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""
BACKBONE_SHARE = 0.9
"""A pair belongs to the backbone if its coverage is at least this share of that of the weakest pair on the best path
between its photos. On oats23 and books21 equal things in different places reach 0.84 at most. docs/algorithms.md,
Look-alikes."""


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """Inliers of all pairs, and the keypoints and cells of the photos that they are in."""

    rows: Mapping[PairId, IndexArray]
    """By pair, (N, 2) keypoints of its inliers in photo 1 and photo 2."""
    seen: Mapping[int, IndexArray]
    """By photo, (K,) number of other photos in which each keypoint has a partner."""
    cells: Mapping[int, IndexArray]
    """By photo, (K,) number of the cell of each keypoint."""


def compute_visibility(matches: MatchGraph, poses: Mapping[PairId, RelativePose]) -> Visibility:
    """Collect the inliers of all pairs, their counts by keypoint, and the cells of all keypoints.

    Args:
        matches: keypoints and raw matches.
        poses: relative poses by pair, with their inliers.
    """
    rows = {pair: matches.matches[pair][pose.inliers].astype(np.int64) for pair, pose in poses.items()}
    photos = sorted({photo for pair in poses for photo in pair})
    seen = {photo: np.zeros(len(matches.keypoints[photo]), np.int64) for photo in photos}
    for pair, found in rows.items():
        for photo, column in zip(pair, found.T, strict=True):
            seen[photo][np.unique(column)] += 1
    images = matches.images
    cells = {
        photo: cell_numbers(matches.keypoints[photo], images[photo].width, images[photo].height) for photo in photos
    }
    return Visibility(rows, seen, cells)


def cell_numbers(x: NDArray[np.float64], width: int, height: int) -> IndexArray:
    """Return the numbers (N,) of the cells of a photo in which pixels lie, less than (`CELLS` + 1) squared.

    Args:
        x: (N, 2) pixels inside the photo.
        width, height: of the photo.
    """
    columns, lines = (x // (max(width, height) / CELLS)).astype(np.int64).T
    return np.asarray(lines * (CELLS + 1) + columns, np.int64)


def coverages(sight: Visibility) -> dict[PairId, float]:
    """Return by pair the share of the known cells that it covers, mean over its two photos, 0 to 1."""
    found = {}
    for pair, rows in sight.rows.items():
        shares = []
        for photo, column in zip(pair, rows.T, strict=True):
            seen, cells = sight.seen[photo], sight.cells[photo]
            hit = np.zeros(len(seen), np.bool_)
            hit[column] = True
            covered = np.unique(cells[hit])
            known = np.unique(cells[hit | (seen >= MIN_OTHER_PHOTOS)])
            shares.append(len(covered) / len(known))
        found[pair] = float(np.mean(shares))
    return found


def backbone(covered: Mapping[PairId, float]) -> set[PairId]:
    """Return the pairs of the maximum spanning tree of coverage, and those nearly as good as the path along it.

    Groups of photos grow along the best pairs. When two of them join, the pair that joins them is the weakest one on
    the path between any photo of the one and any of the other.
    """
    partners: dict[int, list[int]] = {photo: [] for pair in covered for photo in pair}
    for a, b in covered:
        partners[a].append(b)
        partners[b].append(a)
    groups, chosen = DisjointGroups(partners), set()
    for a, b in sorted(covered, key=lambda pair: (-covered[pair], pair)):
        moved = groups.join(a, b)
        inside = set(moved)
        for photo in moved:
            across = (
                other for other in partners[photo] if other not in inside and groups.name[other] == groups.name[a]
            )
            joined = ((min(photo, other), max(photo, other)) for other in across)
            chosen |= {pair for pair in joined if covered[pair] >= BACKBONE_SHARE * covered[a, b]}
    return chosen


# Missing matches: the points that two photos would share if their relative pose were right.
#
# The points of a photo have depths from other pairs. In the scale of the pair in question, they project into its
# other photo, or outside. If the photos are close to each other, points that project inside must have matches there
# (Zach et al. 2010, Heinly et al. 2014). One pair alone may miss many, since matching fails in places; all pairs of
# a photo that claim the same join miss few together.

Cameras = Mapping[int, Calibration]
Poses = Mapping[PairId, RelativePose]
Scales = dict[int, float]

MOST_DEG, MOST_SCALE = 20.0, 1.5
"""Largest change of viewing angle, and of scale, at which a point is matched again. 30 degrees and 2 give the same on
oats23 and books21. docs/algorithms.md, Look-alikes."""
BORDER = 0.05
"""Share of width and height: points that project this near the border may be outside. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
WIDE_RAD = 0.2
"""Depths from wider angles get no more weight. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
MIN_COMMON_POINTS = 8
"""Least number of points that two pairs of a photo must share to determine their relative scale. Chosen by hand; halved
and doubled by `benchmarks.sensitivity`."""
MIN_CELL_POINTS = 2
"""A cell of a photo with fewer expected points expects no match. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class PairDepths:
    """Depths of the keypoints of a photo, from one of its pairs."""

    rows: IndexArray
    """(N,) keypoints of the photo."""
    logs: FloatArray
    """(N,) logarithms of their depths; the pair's baseline is 1."""
    weights: FloatArray
    """(N,) weights, by the angles of their rays."""


class Depths:
    """Depths of keypoints in the scale of any pair of their photo.

    Args:
        matches: keypoints.
        cameras: by photo.
        poses: relative poses.
        sight: their inliers.
    """

    def __init__(self, matches: MatchGraph, cameras: Cameras, poses: Poses, sight: Visibility) -> None:
        self.matches, self.cameras, self.poses, self.sight = matches, cameras, poses, sight
        self.lines: dict[int, FloatArray] = {}
        self.known: dict[tuple[int, int], PairDepths] = {}

    def keypoint_bearings(self, photo: int) -> FloatArray:
        """Return the keypoints of a photo as (K, 9) bearing vectors."""
        if photo not in self.lines:
            self.lines[photo] = bearings(self.matches.keypoints[photo], self.cameras[photo])
        return self.lines[photo]

    def pair_depths(self, photo: int, other: int) -> PairDepths:
        """Return the depths of a photo's points from one pair.

        Args:
            photo: the photo, as named in `poses`.
            other: the other photo of the pair; the two have a pose, in either order.
        """
        if (photo, other) in self.known:
            return self.known[photo, other]
        pair = (min(photo, other), max(photo, other))
        pose, rows = self.poses[pair], self.sight.rows[pair]
        used = np.hstack([self.keypoint_bearings(one)[column] for one, column in zip(pair, rows.T, strict=True)])
        found, front = depths(used, pose.R, pose.t), np.ones(len(rows), np.bool_)
        for one in found:
            front &= one > 0
        h1, h2 = used[:, FIRST] @ pose.R.T, used[:, SECOND]
        lengths = np.linalg.norm(h1, axis=1) * np.linalg.norm(h2, axis=1)
        sines = np.linalg.norm(np.cross(h1, h2), axis=1) / lengths
        weights = np.minimum(sines, WIDE_RAD) ** 2 + 1e-6
        for end, names in enumerate((pair, pair[::-1])):
            self.known[names] = PairDepths(rows[front, end], np.log(found[end][front]), weights[front])
        return self.known[photo, other]

    def merge_depths(self, photo: int, trusted: Iterable[int], doubted: Iterable[int]) -> tuple[FloatArray, Scales]:
        """Return (K,) logarithms of depths from trusted pairs, NaN if there is none, and the log scale of each pair.

        Args:
            photo: whose keypoints.
            trusted: photos whose pairs with it determine the depths.
            doubted: photos whose pairs with it only get a scale.
        """
        total = np.zeros((2, len(self.matches.keypoints[photo])))
        scales: Scales = {}
        known = {other: self.pair_depths(photo, other) for other in trusted}
        waiting = sorted(known, key=lambda other: (-float(known[other].weights.sum()), other))
        while waiting:
            other = next((one for one in waiting if _count_common(known[one], total) >= MIN_COMMON_POINTS), waiting[0])
            if scales and _count_common(known[other], total) < MIN_COMMON_POINTS:
                break
            waiting.remove(other)
            end = known[other]
            scales[other] = _log_scale(end, total) if scales else 0.0
            np.add.at(total[0], end.rows, end.weights * (end.logs - scales[other]))
            np.add.at(total[1], end.rows, end.weights)
        for other in doubted:
            end = self.pair_depths(photo, other)
            if _count_common(end, total) >= MIN_COMMON_POINTS:
                scales[other] = _log_scale(end, total)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(total[1] > 0, total[0] / total[1], np.nan), scales

    def expected_points(self, photo: int, other: int, points: IndexArray, logs: FloatArray) -> IndexArray:
        """Return the points of a photo that the other one must show if their pair is right.

        Args:
            photo: whose points.
            other: photo that should show them.
            points: (N,) keypoints.
            logs: (N,) logarithms of their depths in the scale of the pair.
        """
        R, t = _directed_pose(self.poses, photo, other)
        rays_here = self.keypoint_bearings(photo)[points, FIRST]
        z = np.exp(logs)
        turned = rays_here @ R.T
        there = turned * z[:, None] + t
        image, here, camera = self.matches.images[other], self.cameras[photo], self.cameras[other]
        with np.errstate(invalid="ignore", divide="ignore"):
            x = project(there, camera)
            smaller = depths_along(there, camera) / z * here.K[0, 0] / camera.K[0, 0]
            cosines = (turned * there).sum(1) / np.linalg.norm(turned, axis=1) / np.linalg.norm(there, axis=1)
        expected = is_well_inside(x, image.width, image.height) & is_matched_again(smaller, cosines)
        return np.asarray(points[expected], np.int64)


def is_well_inside(x: FloatArray, width: int, height: int) -> NDArray[np.bool_]:
    """Return (N,) whether pixels lie in a photo, and not at its border.

    Args:
        x: (N, 2) pixels; NaN where a point cannot be seen.
        width, height: of the photo.
    """
    size = np.array([width, height], np.float64)
    return np.asarray(((x > BORDER * size) & (x < (1.0 - BORDER) * size)).all(axis=1))


def is_matched_again(smaller: FloatArray, cosines: FloatArray) -> NDArray[np.bool_]:
    """Return (N,) whether points look so much alike in two photos that matching finds them.

    Args:
        smaller: (N,) their size in the first photo over that in the second.
        cosines: (N,) of the angles between their two viewing rays.
    """
    alike = (smaller < MOST_SCALE) & (smaller > 1.0 / MOST_SCALE) & (cosines > np.cos(np.radians(MOST_DEG)))
    return np.asarray(alike, np.bool_)


def count_missing_cells(photo: int, joined: Iterable[int], trusted: Iterable[int], places: Depths) -> tuple[int, int]:
    """Count the cells of a photo that other photos should show if pairs are right, and those of them without a match.

    Args:
        photo: whose cells.
        joined: photos of the pairs in question with it.
        trusted: photos whose pairs with it are trusted.
        places: depths and poses.
    """
    sight, others = places.sight, sorted(joined)
    logs, scales = places.merge_depths(photo, sorted(trusted), others)
    points = np.flatnonzero(~np.isnan(logs))
    wanted, hit = np.zeros(len(logs), np.bool_), np.zeros(len(logs), np.bool_)
    for other in others:
        pair = (min(photo, other), max(photo, other))
        hit[sight.rows[pair][:, pair.index(photo)]] = True
        if other in scales:
            wanted[places.expected_points(photo, other, points, logs[points] + scales[other])] = True
    cells, counts = np.unique(sight.cells[photo][wanted], return_counts=True)
    cells = cells[counts >= MIN_CELL_POINTS]
    return len(cells), int(np.count_nonzero(~np.isin(cells, sight.cells[photo][hit])))


def _directed_pose(poses: Mapping[PairId, RelativePose], photo: int, other: int) -> tuple[FloatArray, FloatArray]:
    if photo < other:
        return poses[photo, other].R, poses[photo, other].t
    pose = poses[other, photo]
    return pose.R.T, -pose.R.T @ pose.t


def _count_common(end: PairDepths, total: FloatArray) -> int:
    return int(np.count_nonzero(total[1, end.rows] > 0))


def _log_scale(end: PairDepths, total: FloatArray) -> float:
    both = total[1, end.rows] > 0
    rows = end.rows[both]
    return float(np.median(end.logs[both] - total[0, rows] / total[1, rows]))


ALIKE, LOOP, EITHER = "alike", "loop", "either"
LEAST_TRACKED, FEW_TRACKED = 30, 15
"""Least number of matches with both ends on tracks for a pair to be tested, and for one beside known look-alikes.
docs/algorithms.md, Look-alikes. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
SAME_TRACK_SHARE = 0.02
"""A pair with at most this share of its tracked matches on the same track contradicts the backbone. On oats23 and
books21 look-alikes have 0; no pair of kitti51, castle-P19, temple16 and five more sets is below 0.07; where kitchen1000
closes a loop, some have 0. docs/algorithms.md, Look-alikes."""
CONFIRMED_SHARE = 0.1
"""A pair with at least this share of its tracked matches on the same track is confirmed. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
LOW_PERCENTILE, MAX_MISSING, MAX_MISSING_SAME_TURN = 25.0, 0.2, 0.3
"""Contradicting pairs join look-alikes if this percentile, over the photos, of the share of expected cells that are
missing exceeds the limit; the second limit is for pairs whose rotation agrees with the path between them. It is 0.30 on
oats23, 0.28 on books21; 0.12 where the video kitchen1000 (every 15th) closes a loop. Shares over all photos do not
separate them: 0.37, 0.33, 0.25. docs/algorithms.md, Look-alikes."""
SAME_TURN_DEG = 3.0
"""Largest median angle between the rotations of such pairs and of the path at which they agree: 1 degree for that loop,
9 on oats23 and 58 on books21. docs/algorithms.md, Look-alikes."""
LEAST_CELLS, LEAST_PHOTOS = 15, 3
"""Least number of expected cells of a photo, and of such photos of a join, for missing cells to be evidence. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class FeatureTracks:
    """Tracks of the keypoints that the backbone joins."""

    names: Mapping[int, IndexArray]
    """By photo, (K,) number of the track of each keypoint; -1 if no pair of the backbone has it."""

    def count_agreement(self, pair: PairId, rows: IndexArray) -> tuple[int, int]:
        """Count the matches of a pair that have both ends on the same track, and those with both ends on any.

        Args:
            pair: two photos.
            rows: (N, 2) keypoints that match, one column for each photo.
        """
        first, second = (self.names[photo][column] for photo, column in zip(pair, rows.T, strict=True))
        tracked = (first >= 0) & (second >= 0)
        return int(np.count_nonzero(tracked & (first == second))), int(np.count_nonzero(tracked))

    def is_contradicted_by(self, pair: PairId, rows: IndexArray, least: int = LEAST_TRACKED) -> bool:
        """Return whether a pair joins points that the backbone keeps on different tracks.

        Args:
            pair: two photos.
            rows: (N, 2) keypoints that match, one column for each photo.
            least: with fewer tracked matches the answer is no.
        """
        same, tracked = self.count_agreement(pair, rows)
        return tracked >= least and same <= SAME_TRACK_SHARE * tracked


@dataclass(frozen=True, slots=True, eq=False)
class LookAlikeVerdict:
    """Look-alikes that were found, and joins that may be."""

    joins: tuple[LookAlikes, ...]
    """Every join of look-alikes."""
    doubtful: tuple[LookAlikes, ...]
    """Joins that may be look-alikes or loops: their rotation disagrees with the path, but few matches are missing."""
    tracks: FeatureTracks

    def is_look_alike(self, pair: PairId, rows: IndexArray) -> bool:
        """Return whether a pair that was estimated later joins look-alikes, too.

        Args:
            pair: two photos.
            rows: (N, 2) keypoints that match, one column for each photo.
        """
        return bool(self.joins) and self.tracks.is_contradicted_by(pair, rows, FEW_TRACKED)


def find_look_alikes(
    matches: MatchGraph, poses: Mapping[PairId, RelativePose], cameras: Mapping[int, Calibration]
) -> LookAlikeVerdict:
    """Find the pairs that match look-alikes as if they were one thing.

    Args:
        matches: keypoints and raw matches.
        poses: relative poses of all pairs that may be right.
        cameras: by photo.
    """
    sight = compute_visibility(matches, poses)
    best = backbone(coverages(sight))
    tracks = _build_tracks(sight, best)
    doubted = [pair for pair, rows in sight.rows.items() if pair not in best and tracks.is_contradicted_by(pair, rows)]
    if not doubted:
        return LookAlikeVerdict((), (), tracks)
    trusted = best | {pair for pair, rows in sight.rows.items() if _is_confirmed(*tracks.count_agreement(pair, rows))}
    places = Depths(matches, cameras, poses, sight)
    turns = _photo_rotations(trusted, poses)
    friends = _partners(trusted)
    judged = [_judge_join(join, friends, turns, places) for join in group_doubted_pairs(doubted, trusted)]
    joins = [join for join, verdict in judged if verdict == ALIKE]
    doubtful = tuple(join for join, verdict in judged if verdict == EITHER)
    left = poses.keys() - best - {pair for join in joins for pair in join.pairs}
    weak = sorted(pair for pair in left if tracks.is_contradicted_by(pair, sight.rows[pair], FEW_TRACKED))
    close = {frozenset(pair) for pair in trusted}
    for number, join in enumerate(joins):
        also = [pair for pair in weak if any(_has_same_ends(pair, other, close) for other in join.pairs)]
        weak = [pair for pair in weak if pair not in also]
        joins[number] = replace(join, pairs=tuple(sorted((*join.pairs, *also))))
    return LookAlikeVerdict(tuple(joins), doubtful, tracks)


def _build_tracks(sight: Visibility, pairs: Iterable[PairId]) -> FeatureTracks:
    """Join the keypoints of pairs into tracks."""
    starts, count = {}, 0
    for photo, seen in sight.seen.items():
        starts[photo], count = count, count + len(seen)
    ends = [sight.rows[pair] + [starts[photo] for photo in pair] for pair in sorted(pairs)]
    first, second = np.concatenate(ends).T if ends else np.zeros((2, 0), np.int64)
    graph = coo_array((np.ones(len(first), np.bool_), (first, second)), shape=(count, count))
    names = connected_components(graph, directed=False)[1].astype(np.int64)
    joined = np.zeros(count, np.bool_)
    joined[first] = joined[second] = True
    names[~joined] = -1
    return FeatureTracks({photo: names[start : start + len(sight.seen[photo])] for photo, start in starts.items()})


def group_doubted_pairs(doubted: Iterable[PairId], trusted: Iterable[PairId]) -> list[tuple[PairId, ...]]:
    """Group doubted pairs that join the same two places.

    At both ends, their photos are the same or joined by a trusted pair.

    Args:
        doubted: pairs to group.
        trusted: pairs whose two photos count as one place.
    """
    near = _partners(trusted)
    waiting, found = dict.fromkeys(sorted(doubted)), []
    while waiting:
        join = [next(iter(waiting))]
        del waiting[join[0]]
        for a, b in join:
            ends = ((c, d) for c in sorted({a, *near.get(a, ())}) for d in sorted({b, *near.get(b, ())}))
            beside = [pair for c, d in ends if (pair := (min(c, d), max(c, d))) in waiting]
            for pair in beside:
                waiting.pop(pair, None)
            join += dict.fromkeys(beside)
        found.append(tuple(sorted(join)))
    return found


def _has_same_ends(pair: PairId, other: PairId, close: set[frozenset[int]]) -> bool:
    def is_same_place(a: int, b: int) -> bool:
        return a == b or frozenset((a, b)) in close

    (a, b), (c, d) = pair, other
    return (is_same_place(a, c) and is_same_place(b, d)) or (is_same_place(a, d) and is_same_place(b, c))


def _is_confirmed(same: int, tracked: int) -> bool:
    return tracked > 0 and same >= CONFIRMED_SHARE * tracked


def _partners(pairs: Iterable[PairId]) -> dict[int, set[int]]:
    """Return the other photos of the pairs of each photo."""
    found: dict[int, set[int]] = {}
    for a, b in pairs:
        found.setdefault(a, set()).add(b)
        found.setdefault(b, set()).add(a)
    return found


def _judge_join(
    join: tuple[PairId, ...], friends: Mapping[int, set[int]], turns: Mapping[int, FloatArray], places: Depths
) -> tuple[LookAlikes, str]:
    """Judge whether a join is of look-alikes, a loop, or either; return it with its share of missing cells."""
    claimed = _partners(join)
    counts = [
        count_missing_cells(photo, claimed[photo], friends[photo], places)
        for photo in sorted(claimed)
        if photo in friends
    ]
    expected, missing = (sum(column) for column in zip(*counts, strict=True)) if counts else (0, 0)
    shares = [lacking / wanted for wanted, lacking in counts if wanted >= LEAST_CELLS]
    same_turn = _rotation_gap_deg(join, turns, places) <= SAME_TURN_DEG
    limit = MAX_MISSING_SAME_TURN if same_turn else MAX_MISSING
    alike = len(shares) >= LEAST_PHOTOS and float(np.percentile(shares, LOW_PERCENTILE)) > limit
    verdict = ALIKE if alike else LOOP if same_turn else EITHER
    return LookAlikes(join, missing / max(expected, 1)), verdict


def _photo_rotations(trusted: Iterable[PairId], poses: Mapping[PairId, RelativePose]) -> dict[int, FloatArray]:
    """Return the rotations of photos along the trusted pairs."""
    known = {pair: poses[pair] for pair in sorted(trusted)}
    weights = {pair: float(pose.inlier_count) for pair, pose in known.items()}
    return average_rotations({pair: pose.R for pair, pose in known.items()}, weights)[0]


def _rotation_gap_deg(join: tuple[PairId, ...], turns: Mapping[int, FloatArray], places: Depths) -> float:
    """Return the median angle between the rotations of pairs and those along the trusted ones."""
    left = [places.poses[a, b].R.T @ turns[b] @ turns[a].T for a, b in join if a in turns and b in turns]
    if not left:
        return float("inf")
    return float(np.degrees(np.median(Rotation.from_matrix(np.array(left)).magnitude())))
