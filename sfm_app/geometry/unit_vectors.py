"""Directions in space: unit vectors and the angles between them."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


def normalize(vectors: ArrayLike) -> FloatArray:
    """Return vectors (..., 3) with length 1; those of length 0 stay 0."""
    values = np.asarray(vectors, np.float64)
    length = np.linalg.norm(values, axis=-1, keepdims=True)
    return np.asarray(np.divide(values, length, out=np.zeros_like(values), where=length > 0), np.float64)


def axis_angle_deg(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """Return the angle between the lines along vectors, ignoring their signs, in degrees in [0, 90].

    Args:
        first: (..., 3) vectors of any length but zero.
        second: (..., 3) likewise; the two are broadcast.
    """
    a, b = normalize(first), normalize(second)
    # the cross product keeps its digits where the arc cosine loses them
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(sine, np.abs((a * b).sum(axis=-1)))))


def component_along(vectors: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the components (N,) of vectors along an axis, without BLAS, whose rounding depends on its threads.

    Args:
        vectors: (N, 3).
        axis: (3,), of length 1 for components in the unit of the vectors.
    """
    return np.asarray(np.einsum("ni,i->n", vectors, axis))


def perpendicular_component(vector: ArrayLike, axis: FloatArray) -> FloatArray:
    """Return the component of vectors perpendicular to an axis.

    Args:
        vector: (..., 3) one vector or many.
        axis: (3,) unit vector.
    """
    values = np.asarray(vector, np.float64)
    return np.asarray(values - (values @ axis)[..., None] * axis)


def perpendicular_basis(axis: FloatArray) -> FloatArray:
    """Return orthonormal rows e1, e2 (2, 3) with e1 x e2 = axis, a unit vector (3,)."""
    least = np.eye(3)[int(np.argmin(np.abs(axis)))]
    e1 = normalize(perpendicular_component(least, axis))
    return np.stack([e1, np.cross(axis, e1)])


def smallest_eigenvector(matrix: FloatArray, like: FloatArray) -> FloatArray:
    """Return the eigenvector (3,) of the smallest eigenvalue.

    Args:
        matrix: (3, 3), symmetric.
        like: (3,) direction; the sign of the result is such that their dot product is not negative.
    """
    found: FloatArray = np.linalg.eigh(matrix)[1][:, 0]
    return found if found @ like >= 0 else -found
