"""The median of a few numbers, inside kernels."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel


@kernel
def median(values: NDArray[np.float64], count: int) -> float:
    """Sort the first values in place and return their median.

    It replaces NumPy's sort, which takes seconds to compile.

    Args:
        values: (N,) changed.
        count: number of first values used, 1 to N.
    """
    for k in range(1, count):
        value, at = values[k], k
        while at > 0 and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value
    middle: float = 0.5 * (values[(count - 1) // 2] + values[count // 2])
    return middle
