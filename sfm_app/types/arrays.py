"""Array types that all packages share."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
ByteArray = NDArray[np.uint8]
Float32Array = NDArray[np.float32]
DepthArray = NDArray[np.float32]
"""(H, W) depth along the optical axis in scene units, 0 where unknown."""
