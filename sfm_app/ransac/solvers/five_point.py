"""Essential matrices from five rays and their partners (Nistér 2004), by eigenvectors of an action matrix.

The ten cubic equations 2 E E'E = tr(E E') E and det E = 0 in the coordinates of the null space are solved as Stewénius,
Engels and Nistér (2006) do; derived here from the products of linear forms.
"""

from itertools import product

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SAMPLE_SIZE = 5
"""Matches of a sample. Counted: E has five degrees of freedom."""
_MONOMIALS = (
    "xxx", "xxy", "xxz", "xyy", "xyz", "xzz", "yyy", "yyz", "yzz", "zzz",
    "xx1", "xy1", "xz1", "yy1", "yz1", "zz1", "x11", "y11", "z11", "111",
)  # fmt: skip
"""Products of three of x, y, z and 1: the cubic ones, then the basis of what they leave."""
_PLACES = {"".join(sorted(name)): place for place, name in enumerate(_MONOMIALS)}
_SUM = np.zeros((64, 20))
"""Adds up products of three letters to monomials. By definition."""
for _row, _letters in enumerate(product("xyz1", repeat=3)):
    _SUM[_row, _PLACES["".join(sorted(_letters))]] = 1.0
_LEVI_CIVITA = np.zeros((3, 3, 3))
"""Signs of permutations. By definition."""
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _LEVI_CIVITA[_i, _j, _k], _LEVI_CIVITA[_i, _k, _j] = 1.0, -1.0
_REAL = 1e-6
"""Largest imaginary part of a root that counts as real. Chosen by hand; not measured on its own."""


def solve_five_point(p: FloatArray, q: FloatArray) -> FloatArray:
    """Return (M, 3, 3) essential matrices, of Frobenius norm 1, through samples of five matches; none is dropped.

    Args:
        p, q: (S, 5, 3) rays of view 1; partners in view 2.
    """
    rows = (q[..., :, None] * p[..., None, :]).reshape(len(p), SAMPLE_SIZE, 9)
    null = np.linalg.svd(rows)[2][:, SAMPLE_SIZE:].reshape(-1, 4, 3, 3)
    E = np.ascontiguousarray(null.transpose(0, 2, 3, 1))  # (S, 3, 3, 4): linear forms in x, y, z, 1
    products = np.einsum("sika,sjkb->sijab", E, E)
    cubes = 2.0 * np.einsum("sijab,sjkc->sikabc", products, E)
    cubes -= np.einsum("sab,sikc->sikabc", np.einsum("siiab->sab", products), E)
    determinant = np.einsum("ijk,sia,sjb,skc->sabc", _LEVI_CIVITA, E[:, 0], E[:, 1], E[:, 2], optimize=True)
    equations = np.concatenate([cubes.reshape(len(p), 9, 64), determinant.reshape(len(p), 1, 64)], 1) @ _SUM
    sound = np.abs(np.linalg.det(equations[:, :, :10])) > 1e-300
    equations, null = equations[sound], null[sound]
    if not len(null):
        return np.zeros((0, 3, 3))
    left = -np.linalg.solve(equations[:, :, :10], equations[:, :, 10:])
    action = np.zeros((len(null), 10, 10))
    action[:, :6] = left[:, :6]  # x times xx, xy, xz, yy, yz, zz
    action[:, [6, 7, 8, 9], [0, 1, 2, 6]] = 1.0  # x times x, y, z, 1
    if not np.isfinite(action).all():
        action = np.nan_to_num(action, nan=0.0, posinf=0.0, neginf=0.0)
    values, vectors = np.linalg.eig(action)
    last = vectors[:, 9]
    real = (np.abs(values.imag) <= _REAL * (1.0 + np.abs(values))) & (np.abs(last) > 1e-12)
    sample, root = np.nonzero(real)
    roots = (vectors[sample, 6:9, root] / vectors[sample, 9, root][:, None]).real
    found = np.einsum("na,naij->nij", np.column_stack([roots, np.ones(len(roots))]), null[sample])
    lengths = np.linalg.norm(found, axis=(1, 2))
    kept = np.isfinite(lengths) & (lengths > 0.0)
    return np.asarray(found[kept] / lengths[kept, None, None], np.float64)
