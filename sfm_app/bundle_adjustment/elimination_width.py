"""How many photos a photo is tied to while poses are eliminated one after the other.

Photos that share a point are tied, in the normal equations of the poses. In a street few are, wherever it leads; in a
room all are. A factorization costs the square of that number for each photo, and the steps of conjugate gradients grow
with the length of a street.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee


def elimination_width(photo: NDArray[np.int64], point: NDArray[np.int64]) -> float:
    """Return the root mean square width of the envelope of the normal equations, in the order of Cuthill and McKee.

    No elimination in that order fills more, and orders by nested dissection fill less.

    Args:
        photo: (N,) row of the photo of each observation.
        point: (N,) row of the point.

    Returns:
        A number of photos, from 1 to that of all; 0 without observations.
    """
    if not len(photo):
        return 0.0
    shape = int(point.max()) + 1, int(photo.max()) + 1
    seen = coo_array((np.ones(len(photo), np.int32), (point, photo)), shape=shape).tocsr()
    tied = csr_array(seen.T @ seen)
    order = reverse_cuthill_mckee(tied, symmetric_mode=True)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    row, column = (place[ends] for ends in tied.nonzero())
    first = np.arange(len(order))
    np.minimum.at(first, row, column)
    return float(np.sqrt(np.mean((np.arange(len(order)) - first + 1.0) ** 2)))
