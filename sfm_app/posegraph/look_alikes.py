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

from sfm_app.posegraph.coverage import Visibility, backbone, compute_visibility, coverages
from sfm_app.posegraph.missing import Depths, count_missing_cells
from sfm_app.posegraph.rotations import average_rotations
from sfm_app.types import Calibration, LookAlikes, MatchGraph, PairId, RelativePose

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

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
