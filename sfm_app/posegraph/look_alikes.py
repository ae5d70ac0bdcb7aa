"""Detection of equal things in different places, before mapping; docs/algorithms/look-alikes.md has steps and figures.

A relative pose between two equal cans on a table is as good as any. The path between them, along pairs that share most
of their content (`coverages`), distinguishes them: points of the first leave the view, and those of the second are new.

Zach et al. 2010 and Heinly et al. 2014 test for missing matches; Wilson and Snavely 2013 and Yan et al. 2017 test how
tracks connect photos. Both are needed: a wide baseline misses many matches, and a loop loses its tracks.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from sfm_app.camera.bearings import bearings, depths_along, project
from sfm_app.geometry.epipolar import FIRST, SECOND, depths
from sfm_app.posegraph.rotations import DisjointGroups, average_rotations, partners_of
from sfm_app.types import Calibration, LookAlikes, MatchGraph, PairId, RelativePose
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

# Coverage and backbone. Neighbors on a walk share most of the content that the set knows of either. Photos of equal
# things in different places share only the things, however many matches these give, and nothing around them.


class OPTIONS:
    """Detection of look-alikes; docs/algorithms/look-alikes.md has the measurements."""

    min_other_photos: int = 2
    """Photos besides those of the pair in which a known keypoint has partners. Chosen by hand."""
    backbone_share: float = 0.9
    """Least coverage of a backbone pair, as a share of that of the weakest pair on the best path. Measured."""
    min_tracked: int = 30
    """Least matches with both ends on tracks for a pair to be tested. Chosen by hand."""
    min_tracked_nearby: int = 15
    """The same for a pair beside known look-alikes. Chosen by hand."""
    same_track_share: float = 0.02
    """Share of tracked matches on the same track up to which a pair contradicts the backbone. Measured."""
    confirmed_share: float = 0.1
    """Share of tracked matches on the same track that confirms a pair. Chosen by hand."""
    low_percentile: float = 25.0
    """Percentile, over photos, of the missing share of expected cells that the limits concern. Measured."""
    max_missing: float = 0.2
    """Missing share above which pairs join look-alikes. Measured."""
    max_missing_same_rotation: float = 0.3
    """The same where the rotation of the pairs agrees with the path between them. Measured."""
    same_rotation_deg: float = 3.0
    """Largest median angle of such agreement. Measured."""
    min_cells: int = 15
    """Least expected cells of a photo for missing cells to be evidence. Chosen by hand."""
    min_photos: int = 3
    """Least number of such photos of a join. Chosen by hand."""
    max_view_change_deg: float = 20.0
    """Largest change of viewing angle at which a point is matched again. Measured."""
    max_scale: float = 1.5
    """Largest change of scale at which a point is matched again. Measured."""
    border: float = 0.05
    """Share of width and height: points that project this near the border may be outside. Chosen by hand."""
    wide_rad: float = 0.2
    """Radians; depths from wider angles get no more weight. Chosen by hand."""
    min_common_points: int = 8
    """Least points that two pairs of a photo must share for a relative scale. Chosen by hand."""
    min_cell_points: int = 2
    """A cell with fewer expected points expects no match. Chosen by hand."""
    cells: int = 12
    """Cells along the longer side of a photo. Measured."""


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """Inliers of all pairs, and the keypoints and cells of the photos that they are in."""

    rows: Mapping[PairId, IndexArray]
    """By pair, (N, 2) keypoints of its inliers in photo 1 and photo 2."""
    partners: Mapping[int, IndexArray]
    """By photo, (K,) number of other photos in which each keypoint has a partner."""
    cells: Mapping[int, IndexArray]
    """By photo, (K,) number of the cell of each keypoint."""


def compute_visibility(matches: MatchGraph, poses: Mapping[PairId, RelativePose]) -> Visibility:
    """Collect the inliers of all pairs, their counts by keypoint, and the cells of all keypoints."""
    rows = {pair: matches.matches[pair][pose.inliers].astype(np.int64) for pair, pose in poses.items()}
    photos = sorted({photo for pair in poses for photo in pair})
    partners = {photo: np.zeros(len(matches.keypoints[photo]), np.int64) for photo in photos}
    for pair, inliers in rows.items():
        for photo, column in zip(pair, inliers.T, strict=True):
            partners[photo][np.unique(column)] += 1
    images = matches.images
    cells = {k: cell_numbers(matches.keypoints[k], images[k].width, images[k].height) for k in photos}
    return Visibility(rows, partners, cells)


def cell_numbers(x: FloatArray, width: int, height: int) -> IndexArray:
    """Return the numbers (N,) of the cells of pixels (N, 2) inside a photo, less than (`cells` + 1) squared."""
    columns, lines = (x // (max(width, height) / OPTIONS.cells)).astype(np.int64).T
    return np.asarray(lines * (OPTIONS.cells + 1) + columns, np.int64)


def coverages(visibility: Visibility) -> dict[PairId, float]:
    """Return by pair the share of the known cells that it covers, mean over its two photos, 0 to 1."""
    covered_shares = {}
    for pair, rows in visibility.rows.items():
        shares = []
        for photo, column in zip(pair, rows.T, strict=True):
            partners, cells = visibility.partners[photo], visibility.cells[photo]
            hit = np.zeros(len(partners), np.bool_)
            hit[column] = True
            covered = np.unique(cells[hit])
            known = np.unique(cells[hit | (partners >= OPTIONS.min_other_photos)])
            shares.append(len(covered) / len(known))
        covered_shares[pair] = float(np.mean(shares))
    return covered_shares


def backbone(covered: Mapping[PairId, float]) -> set[PairId]:
    """Return the pairs of the maximum spanning tree of coverage, and those nearly as good as the path along it.

    Groups of photos grow along the best pairs. When two of them join, the pair that joins them is the weakest one on
    the path between any photo of the one and any of the other.
    """
    partners = partners_of(covered)
    groups, chosen = DisjointGroups(partners), set()
    for a, b in sorted(covered, key=lambda pair: (-covered[pair], pair)):
        joining = groups.join(a, b)
        inside = set(joining)
        for photo in joining:
            across = (b for b in partners[photo] if b not in inside and groups.name[b] == groups.name[a])
            joined = ((min(photo, other), max(photo, other)) for other in across)
            chosen |= {pair for pair in joined if covered[pair] >= OPTIONS.backbone_share * covered[a, b]}
    return chosen


# Missing matches. The points of a photo have depths from other pairs. In the scale of the pair in question, they
# project into its other photo, or outside. If the photos are close to each other, points that project inside must
# have matches there (Zach et al. 2010, Heinly et al. 2014). One pair alone may miss many, since matching fails in
# places; all pairs of a photo that claim the same join miss few together.

Scales = dict[int, float]


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
    """Depths of keypoints in the scale of any pair of their photo."""

    def __init__(
        self,
        matches: MatchGraph,
        cameras: Mapping[int, Calibration],
        poses: Mapping[PairId, RelativePose],
        visibility: Visibility,
    ) -> None:
        self.matches, self.cameras, self.poses, self.visibility = matches, cameras, poses, visibility
        self.lines: dict[int, FloatArray] = {}
        self.known: dict[tuple[int, int], PairDepths] = {}

    def keypoint_bearings(self, photo: int) -> FloatArray:
        """Return the keypoints of a photo as (K, 9) bearing vectors."""
        if photo not in self.lines:
            self.lines[photo] = bearings(self.matches.keypoints[photo], self.cameras[photo])
        return self.lines[photo]

    def pair_depths(self, photo: int, other: int) -> PairDepths:
        """Return the depths of the points of a photo from its pair with another one."""
        if (photo, other) in self.known:
            return self.known[photo, other]
        pair = (min(photo, other), max(photo, other))
        pose, rows = self.poses[pair], self.visibility.rows[pair]
        used = np.hstack([self.keypoint_bearings(one)[column] for one, column in zip(pair, rows.T, strict=True)])
        pair_of_depths, front = depths(used, pose.R, pose.t), np.ones(len(rows), np.bool_)
        for one in pair_of_depths:
            front &= one > 0
        h1, h2 = used[:, FIRST] @ pose.R.T, used[:, SECOND]
        lengths = np.linalg.norm(h1, axis=1) * np.linalg.norm(h2, axis=1)
        sines = np.linalg.norm(np.cross(h1, h2), axis=1) / lengths
        weights = np.minimum(sines, OPTIONS.wide_rad) ** 2 + 1e-6
        for end, names in enumerate((pair, pair[::-1])):
            self.known[names] = PairDepths(rows[front, end], np.log(pair_of_depths[end][front]), weights[front])
        return self.known[photo, other]

    def merge_depths(self, photo: int, trusted: Iterable[int], doubted: Iterable[int]) -> tuple[FloatArray, Scales]:
        """Return (K,) log depths from trusted pairs, NaN for none, and the log scale of each, also doubted ones."""
        total = np.zeros((2, len(self.matches.keypoints[photo])))
        scales: Scales = {}
        known = {other: self.pair_depths(photo, other) for other in trusted}
        waiting = sorted(known, key=lambda other: (-float(known[other].weights.sum()), other))
        while waiting:
            other = next(
                (one for one in waiting if _count_common(known[one], total) >= OPTIONS.min_common_points), waiting[0]
            )
            if scales and _count_common(known[other], total) < OPTIONS.min_common_points:
                break
            waiting.remove(other)
            end = known[other]
            scales[other] = _log_scale(end, total) if scales else 0.0
            np.add.at(total[0], end.rows, end.weights * (end.logs - scales[other]))
            np.add.at(total[1], end.rows, end.weights)
        for other in doubted:
            end = self.pair_depths(photo, other)
            if _count_common(end, total) >= OPTIONS.min_common_points:
                scales[other] = _log_scale(end, total)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(total[1] > 0, total[0] / total[1], np.nan), scales

    def expected_points(self, photo: int, other: int, points: IndexArray, logs: FloatArray) -> IndexArray:
        """Return the keypoints that another photo must show if their pair, with log depths (N,), is right."""
        pose = self.poses[min(photo, other), max(photo, other)]
        R, t = (pose.R, pose.t) if photo < other else (pose.R.T, -pose.R.T @ pose.t)
        rays_here = self.keypoint_bearings(photo)[points, FIRST]
        z = np.exp(logs)
        rotated = rays_here @ R.T
        there = rotated * z[:, None] + t
        image, here, camera = self.matches.images[other], self.cameras[photo], self.cameras[other]
        with np.errstate(invalid="ignore", divide="ignore"):
            x = project(there, camera)
            size_ratios = depths_along(there, camera) / z * here.K[0, 0] / camera.K[0, 0]
            cosines = (rotated * there).sum(1) / np.linalg.norm(rotated, axis=1) / np.linalg.norm(there, axis=1)
        expected = is_well_inside(x, image.width, image.height) & is_matched_again(size_ratios, cosines)
        return np.asarray(points[expected], np.int64)


def is_well_inside(x: FloatArray, width: int, height: int) -> BoolArray:
    """Return a mask (N,) of the pixels (N, 2) inside a photo and off its border; NaN is outside."""
    size = np.array([width, height], np.float64)
    return np.asarray(((x > OPTIONS.border * size) & (x < (1.0 - OPTIONS.border) * size)).all(axis=1))


def is_matched_again(size_ratios: FloatArray, cosines: FloatArray) -> BoolArray:
    """Return a mask (N,) of the points that look alike in two photos, by ratios of sizes and cosines of rays."""
    alike = (
        (size_ratios < OPTIONS.max_scale)
        & (size_ratios > 1.0 / OPTIONS.max_scale)
        & (cosines > np.cos(np.radians(OPTIONS.max_view_change_deg)))
    )
    return np.asarray(alike, np.bool_)


def count_missing_cells(photo: int, joined: Iterable[int], trusted: Iterable[int], places: Depths) -> tuple[int, int]:
    """Count the cells that photos `joined` should show, by depths with `trusted` ones, and those without a match."""
    visibility, others = places.visibility, sorted(joined)
    logs, scales = places.merge_depths(photo, sorted(trusted), others)
    points = np.flatnonzero(~np.isnan(logs))
    expected, matched = np.zeros(len(logs), np.bool_), np.zeros(len(logs), np.bool_)
    for other in others:
        pair = (min(photo, other), max(photo, other))
        matched[visibility.rows[pair][:, pair.index(photo)]] = True
        if other in scales:
            expected[places.expected_points(photo, other, points, logs[points] + scales[other])] = True
    cells, counts = np.unique(visibility.cells[photo][expected], return_counts=True)
    cells = cells[counts >= OPTIONS.min_cell_points]
    return len(cells), int(np.count_nonzero(~np.isin(cells, visibility.cells[photo][matched])))


def _count_common(end: PairDepths, total: FloatArray) -> int:
    return int(np.count_nonzero(total[1, end.rows] > 0))


def _log_scale(end: PairDepths, total: FloatArray) -> float:
    both = total[1, end.rows] > 0
    rows = end.rows[both]
    return float(np.median(end.logs[both] - total[0, rows] / total[1, rows]))


ALIKE, LOOP, EITHER = "alike", "loop", "either"
"""Verdicts on a join."""


@dataclass(frozen=True, slots=True, eq=False)
class FeatureTracks:
    """Tracks of the keypoints that the backbone joins."""

    names: Mapping[int, IndexArray]
    """By photo, (K,) number of the track of each keypoint; -1 if no pair of the backbone has it."""

    def count_agreement(self, pair: PairId, rows: IndexArray) -> tuple[int, int]:
        """Count the matches `rows` (N, 2) of a pair with both ends on one track, and those with both ends on any."""
        first, second = (self.names[photo][column] for photo, column in zip(pair, rows.T, strict=True))
        tracked = (first >= 0) & (second >= 0)
        return int(np.count_nonzero(tracked & (first == second))), int(np.count_nonzero(tracked))

    def is_contradicted_by(self, pair: PairId, rows: IndexArray, least: int = OPTIONS.min_tracked) -> bool:
        """Return whether a pair joins points on different tracks; no with fewer than `least` tracked matches."""
        same, tracked = self.count_agreement(pair, rows)
        return tracked >= least and same <= OPTIONS.same_track_share * tracked


@dataclass(frozen=True, slots=True, eq=False)
class LookAlikeVerdict:
    """Joins of look-alikes, and doubtful joins."""

    joins: tuple[LookAlikes, ...]
    doubtful: tuple[LookAlikes, ...]
    """Look-alikes or loops: their rotation disagrees with the path, but few matches are missing."""
    tracks: FeatureTracks

    def is_look_alike(self, pair: PairId, rows: IndexArray) -> bool:
        """Return whether a pair that was estimated later joins look-alikes, too, by its matches (N, 2)."""
        return bool(self.joins) and self.tracks.is_contradicted_by(pair, rows, OPTIONS.min_tracked_nearby)


def find_look_alikes(
    matches: MatchGraph, poses: Mapping[PairId, RelativePose], cameras: Mapping[int, Calibration]
) -> LookAlikeVerdict:
    """Find the pairs that match look-alikes as if they were one thing, among poses that may be right."""
    visibility = compute_visibility(matches, poses)
    best = backbone(coverages(visibility))
    tracks = _build_tracks(visibility, best)
    rows_of = visibility.rows
    doubted = [pair for pair, rows in rows_of.items() if pair not in best and tracks.is_contradicted_by(pair, rows)]
    if not doubted:
        return LookAlikeVerdict((), (), tracks)
    trusted = best | {pair for pair, rows in rows_of.items() if _is_confirmed(*tracks.count_agreement(pair, rows))}
    places = Depths(matches, cameras, poses, visibility)
    along = {pair: poses[pair] for pair in sorted(trusted)}
    weights = {pair: float(pose.inlier_count) for pair, pose in along.items()}
    rotations, _ = average_rotations({pair: pose.R for pair, pose in along.items()}, weights)
    partners = partners_of(trusted)
    judged = [_judge_join(join, partners, rotations, places) for join in group_doubted_pairs(doubted, trusted)]
    joins = [join for join, verdict in judged if verdict == ALIKE]
    doubtful = tuple(join for join, verdict in judged if verdict == EITHER)
    others = poses.keys() - best - {pair for join in joins for pair in join.pairs}
    weak = {pair for pair in others if tracks.is_contradicted_by(pair, rows_of[pair], OPTIONS.min_tracked_nearby)}
    complete = tuple(_add_weak_pairs(join, weak, partners) for join in joins)
    return LookAlikeVerdict(complete, doubtful, tracks)


def _build_tracks(visibility: Visibility, pairs: Iterable[PairId]) -> FeatureTracks:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    starts, count = {}, 0
    for photo, keypoints in visibility.partners.items():
        starts[photo], count = count, count + len(keypoints)
    ends = [visibility.rows[pair] + [starts[photo] for photo in pair] for pair in sorted(pairs)]
    first, second = np.concatenate(ends).T if ends else np.zeros((2, 0), np.int64)
    graph = coo_array((np.ones(len(first), np.bool_), (first, second)), shape=(count, count))
    names = connected_components(graph, directed=False)[1].astype(np.int64)
    joined = np.zeros(count, np.bool_)
    joined[first] = joined[second] = True
    names[~joined] = -1
    return FeatureTracks({k: names[start : start + len(visibility.partners[k])] for k, start in starts.items()})


def group_doubted_pairs(doubted: Iterable[PairId], trusted: Iterable[PairId]) -> list[tuple[PairId, ...]]:
    """Group doubted pairs that join the same two places: their photos are the same or joined by a trusted pair."""
    neighbors = partners_of(trusted)
    waiting, groups = dict.fromkeys(sorted(doubted)), []
    while waiting:
        join = [next(iter(waiting))]
        del waiting[join[0]]
        for known in join:
            adjacent = _pairs_beside(known, neighbors, waiting)
            for pair in adjacent:
                del waiting[pair]
            join += adjacent
        groups.append(tuple(sorted(join)))
    return groups


def _pairs_beside(known: PairId, neighbors: Mapping[int, set[int]], among: Collection[PairId]) -> list[PairId]:
    """Return those `among` pairs that join the same two places as a known one."""
    first, second = ({photo, *neighbors.get(photo, ())} for photo in known)
    ends = ((min(a, b), max(a, b)) for a in sorted(first) for b in sorted(second))
    return list(dict.fromkeys(pair for pair in ends if pair in among))


def _add_weak_pairs(join: LookAlikes, weak: set[PairId], partners: Mapping[int, set[int]]) -> LookAlikes:
    """Move the weak pairs between the two places of a join from the set into the join."""
    also = {pair for known in join.pairs for pair in _pairs_beside(known, partners, weak)}
    weak -= also
    return replace(join, pairs=tuple(sorted((*join.pairs, *also))))


def _is_confirmed(same: int, tracked: int) -> bool:
    return tracked > 0 and same >= OPTIONS.confirmed_share * tracked


def _judge_join(
    join: tuple[PairId, ...], partners: Mapping[int, set[int]], rotations: Mapping[int, FloatArray], places: Depths
) -> tuple[LookAlikes, str]:
    claimed = partners_of(join)
    counts = [count_missing_cells(k, claimed[k], partners[k], places) for k in sorted(claimed) if k in partners]
    expected, missing = (sum(column) for column in zip(*counts, strict=True)) if counts else (0, 0)
    shares = [lost / due for due, lost in counts if due >= OPTIONS.min_cells]
    same_turn = _rotation_gap_deg(join, rotations, places) <= OPTIONS.same_rotation_deg
    limit = OPTIONS.max_missing_same_rotation if same_turn else OPTIONS.max_missing
    alike = len(shares) >= OPTIONS.min_photos and float(np.percentile(shares, OPTIONS.low_percentile)) > limit
    verdict = ALIKE if alike else LOOP if same_turn else EITHER
    return LookAlikes(join, missing / max(expected, 1)), verdict


def _rotation_gap_deg(join: tuple[PairId, ...], rotations: Mapping[int, FloatArray], places: Depths) -> float:
    """Return the median angle between the rotations of pairs and those along the trusted ones."""
    from scipy.spatial.transform import Rotation

    products = [
        places.poses[a, b].R.T @ rotations[b] @ rotations[a].T for a, b in join if a in rotations and b in rotations
    ]
    if not products:
        return float("inf")
    return float(np.degrees(np.median(Rotation.from_matrix(np.array(products)).magnitude())))
