"""The Schur complement of a bundle: points are eliminated one by one, without a matrix of all observations.

A point couples all views that see it. What it leaves behind is added to the blocks of these views, so that time grows
with the squares of the track lengths, and memory with the pairs of photos that share a point.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from sfm_app.bundle_adjustment.elimination import POSE
from sfm_app.geometry.lenses.projections import CAMERA
from sfm_app.jit import kernel

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Linearized:
    """Weighted derivatives of all observations; those of a point by it are orthonormal."""

    photo: IndexArray
    """(N,) row of the photo of each observation."""
    camera: IndexArray
    """(N,) row of its camera."""
    point: IndexArray
    """(N,) row of its point."""
    by_view: FloatArray
    """(N, 2, 18) derivatives by pose and camera."""
    by_point: FloatArray
    """(N, 2, 3) derivatives by the whitened point."""
    counts: tuple[int, int, int]
    """Photos I, cameras C and points P."""

    def sum_by_point(self, values: FloatArray) -> FloatArray:
        """Return (P, 3) products of the derivatives by points with a value (N, 2) for each observation."""
        along = np.einsum("nki,nk->ni", self.by_point, values)
        return np.stack([np.bincount(self.point, along[:, i], self.counts[2]) for i in range(3)], axis=1)

    def drop_points(self, values: FloatArray) -> FloatArray:
        """Return (N, 2) what is left of a value for each observation after the best shift of the points."""
        shifts = self.sum_by_point(values)[self.point]
        return np.asarray(values - np.einsum("nki,ni->nk", self.by_point, shifts), np.float64)

    def sum_by_view(self, values: FloatArray) -> FloatArray:
        """Return (6I + 12C,) products of the derivatives by poses and cameras with values (N, 2)."""
        along = np.einsum("nki,nk->ni", self.by_view, values)
        poses = [np.bincount(self.photo, along[:, i], self.counts[0]) for i in range(POSE)]
        cameras = [np.bincount(self.camera, along[:, POSE + i], self.counts[1]) for i in range(CAMERA)]
        return np.concatenate([np.stack(poses, axis=1).ravel(), np.stack(cameras, axis=1).ravel()])

    def camera_squares(self) -> FloatArray:
        """Return (12C,) sums of the squared derivatives by each parameter of the cameras."""
        squares = np.einsum("nki,nki->ni", self.by_view[:, :, POSE:], self.by_view[:, :, POSE:])
        found = [np.bincount(self.camera, squares[:, i], self.counts[1]) for i in range(CAMERA)]
        return np.stack(found, axis=1, dtype=np.float64).ravel()

    def move(self, poses: FloatArray, cameras: FloatArray) -> FloatArray:
        """Return (N, 2) changes of the projections.

        Args:
            poses: (6I,) changes of the poses.
            cameras: (12C,) changes of the cameras.
        """
        change = np.hstack([poses.reshape(-1, POSE)[self.photo], cameras.reshape(-1, CAMERA)[self.camera]])
        return np.asarray(np.einsum("nki,ni->nk", self.by_view, change), np.float64)

    def score(self, give: FloatArray, left_over: FloatArray) -> FloatArray:
        """Return the scores (I, 12C) of the cameras' parameters, with poses and points eliminated.

        Args:
            give: (6I, 12C) decrease of the best change of the poses per change of the cameras.
            left_over: (N, 2) residuals after poses and points.
        """
        found = np.zeros((give.shape[1], self.counts[0]))
        observed = self.photo, self.camera, self.point, self.by_view, self.by_point
        add_scores(observed, np.ascontiguousarray(give.T), left_over, self.counts[2], found)
        return found.T


def eliminate_points(seen: Linearized, damping: float) -> tuple[sparse.csr_array, FloatArray]:
    """Return the matrix (6I, 6I) of the poses, and the rows (12C, 6I + 12C) of the cameras, after the points.

    Args:
        seen: all observations.
        damping: added to the diagonal.
    """
    photos, cameras, points = seen.counts
    A = np.einsum("nki,nkj->nij", seen.by_point, seen.by_view)
    order = np.lexsort((seen.photo, seen.point))
    pattern = _pairs_of_photos(seen)
    blocks = np.zeros((pattern.nnz, POSE, POSE))
    couple_poses(
        (seen.photo[order], seen.point[order], seen.by_view[order, :, :POSE], A[order, :, :POSE]),
        (np.argsort(seen.photo[order], kind="stable"), _starts(seen.photo, photos), _starts(seen.point, points)),
        (pattern.indptr, pattern.indices),
        damping,
        blocks,
    )
    S = sparse.bsr_array((blocks, pattern.indices, pattern.indptr), shape=(POSE * photos, POSE * photos)).tocsr()
    names, group = np.unique(seen.point * cameras + seen.camera, return_inverse=True)
    sums = np.zeros((len(names), 3, CAMERA))
    rows = np.zeros((CAMERA * cameras, POSE * photos + CAMERA * cameras))
    couple_cameras(
        (seen.photo, seen.camera, seen.point, seen.by_view, A),
        (group, names % max(cameras, 1), _starts(names // max(cameras, 1), points), sums),
        POSE * photos,
        damping,
        rows,
    )
    return S, rows


def _pairs_of_photos(seen: Linearized) -> sparse.csr_array:
    """Return a matrix (I, I) with an entry for each photo and each pair that shares a point, columns ascending."""
    photos, _, points = seen.counts
    ones = np.ones(len(seen.photo), np.int32)
    sight = sparse.csr_array((ones, (seen.photo, seen.point)), shape=(photos, points))
    pattern = sparse.csr_array(sight @ sight.T + sparse.eye_array(photos, dtype=np.int32))
    pattern.sort_indices()
    return pattern


def _starts(rows: IndexArray, count: int) -> IndexArray:
    """Return (count + 1,) where the observations of each row begin, once they are in the order of their rows."""
    return np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=count))]).astype(np.int64)


@kernel
def couple_poses(observed: Any, order: Any, pattern: Any, damping: float, blocks: FloatArray) -> None:
    """Add up the blocks of all pairs of photos, in place.

    Args:
        observed: by point, and by photo for each point: (N,) photo and (N,) point; (N, 2, 6) derivatives by pose, and
            their products (N, 3, 6) with those by point.
        order: these observations by photo; where those of each photo begin there, and those of each point above.
        pattern: first block of each photo, and the other photo of each block, ascending.
        damping: added to the diagonal.
        blocks: (B, 6, 6), zeros at first.
    """
    photo, point, by_pose, A = observed
    by_photo, photo_starts, point_starts = order
    starts, others = pattern
    photos = len(photo_starts) - 1
    place = np.zeros(photos, np.int64)
    for i in range(photos):
        for e in range(starts[i], starts[i + 1]):
            place[others[e]] = e
        own = place[i]
        for u in range(POSE):
            blocks[own, u, u] += damping
        for a in range(photo_starts[i], photo_starts[i + 1]):
            k = by_photo[a]
            for u in range(POSE):
                for v in range(POSE):
                    blocks[own, u, v] += by_pose[k, 0, u] * by_pose[k, 0, v] + by_pose[k, 1, u] * by_pose[k, 1, v]
            first = k
            while first > point_starts[point[k]] and photo[first - 1] == i:
                first -= 1
            for m in range(first, point_starts[point[k] + 1]):
                e = place[photo[m]]
                for u in range(POSE):
                    x, y, z = A[k, 0, u], A[k, 1, u], A[k, 2, u]
                    for v in range(POSE):
                        blocks[e, u, v] -= x * A[m, 0, v] + y * A[m, 1, v] + z * A[m, 2, v]
    mirror_blocks(starts, others, blocks)


@kernel
def mirror_blocks(starts: Any, others: Any, blocks: FloatArray) -> None:
    """Copy the blocks above the diagonal to their places below, in place.

    Args:
        starts, others: the pattern, as in `couple_poses`.
        blocks: (B, 6, 6), without those below the diagonal at first.
    """
    below = starts[:-1].astype(np.int64)
    for i in range(len(starts) - 1):
        for e in range(starts[i], starts[i + 1]):
            j = others[e]
            if j > i:  # rows ascend, so those of j are met in their order
                for u in range(POSE):  # assigning blocks compiles for a second
                    for v in range(POSE):
                        blocks[below[j], u, v] = blocks[e, v, u]
                below[j] += 1


@kernel
def couple_cameras(observed: Any, groups: Any, poses: int, damping: float, rows: FloatArray) -> None:
    """Add up the rows of the cameras, in place.

    Args:
        observed: (N,) photo, camera and point; derivatives as in `couple_poses`.
        groups: (N,) group of the observations of a point by one camera; (G,) their cameras; first group of each point;
            (G, 3, 12) zeros.
        poses: columns of the poses, before those of the cameras.
        damping: added to the diagonal.
        rows: (12C, 6I + 12C), zeros at first.
    """
    photo, camera, point, by_view, A = observed
    group, camera_of, starts, sums = groups
    for u in range(len(rows)):
        rows[u, poses + u] += damping
    for k in range(len(photo)):
        first, column = CAMERA * camera[k], POSE * photo[k]
        for u in range(CAMERA):
            x, y = by_view[k, 0, POSE + u], by_view[k, 1, POSE + u]
            for v in range(POSE):
                rows[first + u, column + v] += x * by_view[k, 0, v] + y * by_view[k, 1, v]
            for v in range(CAMERA):
                rows[first + u, poses + first + v] += x * by_view[k, 0, POSE + v] + y * by_view[k, 1, POSE + v]
            for axis in range(3):
                sums[group[k], axis, u] += A[k, axis, POSE + u]
    for k in range(len(photo)):
        column = POSE * photo[k]
        for g in range(starts[point[k]], starts[point[k] + 1]):
            first = CAMERA * camera_of[g]
            for u in range(CAMERA):
                for v in range(POSE):
                    for axis in range(3):
                        rows[first + u, column + v] -= sums[g, axis, u] * A[k, axis, v]
    for p in range(len(starts) - 1):
        for g in range(starts[p], starts[p + 1]):
            for h in range(starts[p], starts[p + 1]):
                first, second = CAMERA * camera_of[g], poses + CAMERA * camera_of[h]
                for u in range(CAMERA):
                    for v in range(CAMERA):
                        for axis in range(3):
                            rows[first + u, second + v] -= sums[g, axis, u] * sums[h, axis, v]


@kernel
def add_scores(observed: Any, give: FloatArray, left_over: FloatArray, points: int, scores: FloatArray) -> None:
    """Add up the scores of each photo, in place, one parameter after the other.

    Args:
        observed: (N,) photo, camera and point; (N, 2, 18) and (N, 2, 3) derivatives by view and point.
        give: (12C, 6I) decrease of the best change of the poses.
        left_over: (N, 2) residuals.
        points: P.
        scores: (12C, I), zeros at first.
    """
    photo, camera, point, by_view, by_point = observed
    change = np.empty((len(photo), 2))
    for column in range(len(give)):
        own, place = column // CAMERA, POSE + column % CAMERA
        along = np.zeros((points, 3))
        for k in range(len(photo)):
            for row in range(2):
                total = by_view[k, row, place] if camera[k] == own else 0.0
                for v in range(POSE):
                    total -= by_view[k, row, v] * give[column, POSE * photo[k] + v]
                change[k, row] = total
                for axis in range(3):
                    along[point[k], axis] += by_point[k, row, axis] * total
        for k in range(len(photo)):
            for row in range(2):
                left = change[k, row]
                for axis in range(3):
                    left -= by_point[k, row, axis] * along[point[k], axis]
                scores[column, photo[k]] += left * left_over[k, row]
