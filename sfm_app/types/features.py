"""Features of one photo, as feature methods return them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Keypoints of one picture, the best first, with the data that their method needs to match them."""

    size: tuple[int, int]
    """Width and height of the picture in pixels."""
    keypoints: NDArray[np.float64]
    """(N, 2) x and y in pixels of the picture; the center of the top-left pixel is (0.5, 0.5)."""
    values: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Descriptors, scores and the like, with N rows each."""

    def __len__(self) -> int:
        return len(self.keypoints)

    def select(self, rows: NDArray[Any]) -> "Features":
        """Return the features in these rows."""
        return Features(self.size, self.keypoints[rows], {name: value[rows] for name, value in self.values.items()})
