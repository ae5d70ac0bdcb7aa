"""The frames along a texture in which a normal map is stored, as glTF 2.0 has them."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.unit_vectors import normalize

FloatArray = NDArray[np.float64]

DEGENERATE = 1e-6
"""Share of its longest possible length below which a tangent has no direction. Chosen by hand."""


def corner_tangents(
    vertices: FloatArray,
    normals: FloatArray,
    faces: NDArray[np.int64],
    uv: NDArray[np.float32],
    page: NDArray[np.int32],
) -> NDArray[np.float32]:
    """Return tangents (T, 3, 4) of the corners of triangles: a unit vector, and the handedness, 1 or -1.

    The tangent points right in the texture; the bitangent, handedness times the cross product of normal and tangent,
    points up. A tangent is the mean over the triangles that share a vertex, its place on the page and the handedness,
    weighted by their angles there, at a right angle to the normal.

    Args:
        vertices, normals: (V, 3), the latter unit vectors.
        faces: (T, 3) vertex indices.
        uv, page: (T, 3, 2) places of the corners on their page, from its top left, and (T,) the page.
    """
    corners = vertices[faces]
    along, handed = _face_tangents(corners, uv.astype(np.float64))
    weighted = corner_angles(corners)[:, :, None] * along[:, None, :]
    total = _group_sums(weighted.reshape(-1, 3), _shared_corners(faces, uv, page, handed))
    found = _straighten(total, normals[faces].reshape(-1, 3)).reshape(-1, 3, 3)
    return np.concatenate([found, np.repeat(handed, 3).reshape(-1, 3, 1)], axis=2).astype(np.float32)


def corner_angles(corners: FloatArray) -> FloatArray:
    """Return (T, 3) the angles of triangles in radians.

    Args:
        corners: (T, 3, 3) their corners.
    """
    ahead = normalize(np.roll(corners, -1, axis=1) - corners)
    cosine = -(ahead * np.roll(ahead, 1, axis=1)).sum(axis=2)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _group_sums(values: FloatArray, group: NDArray[np.int64]) -> FloatArray:
    """Return for each of N rows (N, 3) the sum over its group (N,)."""
    size = int(group.max(initial=-1)) + 1
    total = np.stack([np.bincount(group, column, size) for column in values.T], axis=1)
    return np.asarray(total[group], np.float64)


def _face_tangents(corners: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (T, 3) where the texture goes right on each triangle, as a unit vector, and (T,) the handedness."""
    b, c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (ub, vb), (uc, vc) = (places[:, 1] - places[:, 0]).T, (places[:, 2] - places[:, 0]).T
    turn = ub * vc - uc * vb
    # v grows downward: triangles that are counter-clockwise from outside turn to the negative where nothing is mirrored
    handed = np.where(turn > 0, -1.0, 1.0)
    return normalize(np.sign(turn)[:, None] * (vc[:, None] * b - vb[:, None] * c)), handed


def _shared_corners(
    faces: NDArray[np.int64], uv: NDArray[np.float32], page: NDArray[np.int32], handed: FloatArray
) -> NDArray[np.int64]:
    """Return (3 T,) for each corner the number of the group that has vertex, place, page and handedness in common."""
    place = uv.reshape(-1, 2)
    keys = (place[:, 1], place[:, 0], np.repeat(handed, 3), np.repeat(page, 3), faces.ravel())
    order = np.lexsort(keys)
    first = np.zeros(len(order), bool)
    for key in keys:
        first[1:] |= np.diff(key[order]) != 0
    found = np.empty(len(order), np.int64)
    found[order] = np.cumsum(first)
    return found


def _straighten(tangents: FloatArray, normals: FloatArray) -> FloatArray:
    """Return unit vectors (N, 3) at right angles to normals, as close to tangents as can be; any where those have none.

    Args:
        tangents: (N, 3) of any length.
        normals: (N, 3) unit vectors.
    """
    straight = tangents - (tangents * normals).sum(axis=1, keepdims=True) * normals
    length = np.linalg.norm(straight, axis=1)
    lost = length <= DEGENERATE * np.linalg.norm(tangents, axis=1)
    away = np.eye(3)[np.abs(normals[lost]).argmin(axis=1)]
    straight[lost] = away - (away * normals[lost]).sum(axis=1, keepdims=True) * normals[lost]
    return normalize(straight)
