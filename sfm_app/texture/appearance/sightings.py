"""Which photos see which triangles, in lists: a photo sees few of a town's triangles."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.appearance.view_scoring import FaceView
from sfm_app.texture.facets import NONE, IntArray

IndexArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """N views of triangles in photos. Those of photo p are the rows starts[p] to starts[p + 1] - 1."""

    starts: IndexArray
    """(P + 1,)"""
    face: IntArray
    """(N,) triangles, ascending within a photo."""
    worth: NDArray[np.float32]
    """(N,) of each view, see `FaceView`; negative for outliers, which show something other than the surface."""
    colors: NDArray[np.uint8]
    """(N, 3) RGB."""
    face_starts: IndexArray
    """(T + 1,) the views of triangle f are face_rows[face_starts[f]] to face_rows[face_starts[f + 1] - 1]."""
    face_rows: IndexArray
    """(N,) rows by triangle, ascending for each."""

    @property
    def photos(self) -> int:
        """Number of photos P."""
        return len(self.starts) - 1

    @property
    def triangles(self) -> int:
        """Number of triangles T."""
        return len(self.face_starts) - 1

    @property
    def photo(self) -> IntArray:
        """(N,) photo of each row."""
        return np.repeat(np.arange(self.photos, dtype=np.int32), np.diff(self.starts))

    def rows(self, photo: int) -> slice:
        """Return the rows of a photo."""
        return slice(int(self.starts[photo]), int(self.starts[photo + 1]))

    def find(self, photos: IndexArray | int, faces: NDArray[np.integer]) -> IndexArray:
        """Return the rows of views, -1 for those that are not there.

        Args:
            photos: (M,) photo of each view, or one for all.
            faces: (M,) triangle of each view; -1 for none.
        """
        found = np.full(faces.shape, NONE, np.int64)
        _find(self.starts, self.face, np.broadcast_to(np.asarray(photos, np.int64), faces.shape).ravel(),
              faces.ravel().astype(np.int64), found.ravel())  # fmt: skip
        return found

    def is_usable(self, photos: IndexArray | int, faces: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Return (M,) whether photos see triangles and show the surface there.

        Args:
            photos: (M,) photo of each view, or one for all.
            faces: (M,) triangle of each view; -1 for none.
        """
        row = self.find(photos, faces)
        return np.asarray((row != NONE) & (self.worth[row] > 0)) if len(self.worth) else np.zeros(row.shape, np.bool_)

    def usable_faces(self, photo: int) -> IndexArray:
        """Return (M,) the triangles that a photo may be used for, ascending."""
        rows = self.rows(photo)
        return self.face[rows][self.worth[rows] > 0].astype(np.int64)

    def select_triangles(self, kept: NDArray[np.bool_]) -> "Sightings":
        """Return the views of some triangles, which are numbered anew.

        Args:
            kept: (T,) triangles to keep.
        """
        return _gather(self, kept[self.face], np.cumsum(kept) - 1, int(kept.sum()))

    def with_worth(self, worth: NDArray[np.float32]) -> "Sightings":
        """Return the same views with another worth."""
        return replace(self, worth=worth)


def list_sightings(looks: Sequence[FaceView | None], triangles: int) -> Sightings:
    """List what all photos see.

    Args:
        looks: of each photo; None where it cannot be read.
        triangles: of the surface.
    """
    empty = FaceView(np.empty(0, np.int32), np.empty(0, np.float32), np.empty((0, 3), np.uint8), 0.0)
    found = [look or empty for look in looks]
    return make_sightings(
        np.array([len(look.face) for look in found], np.int64),
        np.concatenate([empty.face, *(look.face for look in found)]),
        np.concatenate([empty.worth, *(look.worth for look in found)]),
        np.concatenate([empty.color, *(look.color for look in found)]),
        triangles,
    )


def make_sightings(
    counts: IndexArray, face: IntArray, worth: NDArray[np.float32], colors: NDArray[np.uint8], triangles: int
) -> Sightings:
    """List views by photo and by triangle.

    Args:
        counts: (P,) views of each photo.
        face: (N,) triangles, ascending within a photo.
        worth: (N,) of each view.
        colors: (N, 3) RGB.
        triangles: of the surface.
    """
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    face_starts = np.concatenate([[0], np.cumsum(np.bincount(face, minlength=triangles))]).astype(np.int64)
    rows = np.empty(len(face), np.int64)
    _rank(face, face_starts[:-1].copy(), rows)
    return Sightings(starts, face, worth, colors, face_starts, rows)


def _gather(old: Sightings, kept: NDArray[np.bool_], number: IndexArray, triangles: int) -> Sightings:
    counts = np.diff(np.concatenate([[0], np.cumsum(kept)])[old.starts])
    face = number[old.face[kept]].astype(np.int32)
    return make_sightings(counts, face, old.worth[kept], old.colors[kept], triangles)


@kernel
def _rank(face: IntArray, next_place: IndexArray, rows: IndexArray) -> None:
    """Sort rows by triangle, by counting."""
    for row in range(len(face)):
        rows[next_place[face[row]]] = row
        next_place[face[row]] += 1


@kernel
def _find(starts: IndexArray, face: IntArray, photos: IndexArray, faces: IndexArray, found: IndexArray) -> None:
    """Find views by bisection among the rows of their photo."""
    for k in range(len(faces)):
        if faces[k] == NONE or photos[k] == NONE:
            continue
        low, high = starts[photos[k]], starts[photos[k] + 1]
        while low < high:
            middle = (low + high) // 2
            if face[middle] < faces[k]:
                low = middle + 1
            else:
                high = middle
        if low < starts[photos[k] + 1] and face[low] == faces[k]:
            found[k] = low
