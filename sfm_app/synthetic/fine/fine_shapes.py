"""Build the shapes of fine detail: reliefs, and tubes along a line."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sfm_app.synthetic.scenes.shapes import Shape, grid

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
Height = Callable[[FloatArray, FloatArray], FloatArray]
"""Returns the height above the plane z = 0 at x and y."""


def relief(height: Height, width: float, high: float, spacing: float) -> Shape:
    """Return a relief that faces +z, centered in x and standing on y = 0; nothing closes its back.

    Args:
        height: above the plane z = 0, at arrays x and y of one shape.
        width: along x.
        high: along y.
        spacing: approximate side of a square of its grid.
    """
    columns, rows = (1 + max(1, round(size / spacing)) for size in (width, high))
    plane, faces = grid(np.linspace(-width / 2, width / 2, columns), np.linspace(0.0, high, rows))
    x, y = plane.T.reshape(2, columns, rows)
    z = height(x, y)
    up_x, up_y = np.gradient(z, width / (columns - 1), high / (rows - 1))
    normals = np.stack([-up_x, -up_y, np.ones_like(z)], -1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    return Shape(vertices, faces, normals, vertices)


def tube(line: FloatArray, segments: int = 10) -> Shape:
    """Return a round tube along a line, pointed at both ends.

    Args:
        line: (N, 4) points and the radius there, N >= 2; bends less than a right angle from point to point.
        segments: sides of its section.
    """
    path, radius = line[:, :3], line[:, 3]
    ways = np.gradient(path, axis=0)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    side = np.empty_like(ways)
    side[0] = np.cross(ways[0], np.eye(3)[np.argmin(np.abs(ways[0]))])
    for k in range(1, len(path)):  # carried along without turning about the line
        side[k] = side[k - 1] - (side[k - 1] @ ways[k]) * ways[k]
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = 2.0 * math.pi * np.arange(segments) / segments
    around = np.cross(ways, side)
    out = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * around[:, None]
    rings = path[:, None] + radius[:, None, None] * out
    count = len(path) * segments
    vertices = np.concatenate([rings.reshape(-1, 3), path[[0, -1]]])
    normals = np.concatenate([out.reshape(-1, 3), [-ways[0], ways[-1]]])
    return Shape(vertices, _tube_faces(len(path), segments, count), normals, vertices)


def _tube_faces(rings: int, segments: int, first_end: int) -> IndexArray:
    here = np.arange(segments)
    there = (here + 1) % segments
    start = segments * np.arange(rings - 1)[:, None]
    a, b, c, d = start + here, start + there, start + segments + here, start + segments + there
    sides = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    last = segments * (rings - 1)
    low = np.stack([np.full(segments, first_end), there, here], -1)
    high = np.stack([np.full(segments, first_end + 1), last + here, last + there], -1)
    return np.concatenate([sides, low, high])


def ridge(distance: FloatArray, width: float) -> FloatArray:
    """Return the profile of a rounded ridge: 1 in the middle, 0 from half its width on.

    Args:
        distance: from its middle line, >= 0.
        width: of its foot.
    """
    return np.asarray(np.sqrt(np.maximum(1.0 - (2.0 * distance / width) ** 2, 0.0)))


def pebbles(x: FloatArray, y: FloatArray, size: tuple[float, float], spacing: float, seed: int) -> FloatArray:
    """Return the height (..., ) of gravel: flattened balls at random places, the highest of which shows.

    Args:
        x, y: positions, arrays of one shape.
        size: smallest and largest radius.
        spacing: mean distance of their middles.
        seed: same seed, same gravel.
    """
    rng = np.random.default_rng([seed, 41])
    low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    count = int(np.prod(high - low) / spacing**2)
    middles, radii = rng.uniform(low, high, (count, 2)), rng.uniform(*size, count)
    sunk = radii * rng.uniform(0.1, 0.6, count)
    found = np.zeros_like(x)
    steps = (high - low) / (np.array(x.shape) - 1)
    for middle, radius, depth in zip(middles, radii, sunk, strict=True):
        first = np.maximum(np.floor((middle - radius - low) / steps).astype(int), 0)
        last = np.ceil((middle + radius - low) / steps).astype(int) + 1
        box = np.s_[first[0] : last[0], first[1] : last[1]]
        square = (x[box] - middle[0]) ** 2 + (y[box] - middle[1]) ** 2
        ball = 0.8 * np.sqrt(np.maximum(radius**2 - square, 0.0)) - depth
        found[box] = np.maximum(found[box], ball)
    return found
