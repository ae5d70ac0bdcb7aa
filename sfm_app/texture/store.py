"""The interface for reading photos and for keeping intermediate results of a run."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sfm_app.texture.views import PhotoView


class Store(Protocol):
    """Reads photos, and keeps arrays by name; kept arrays come from the same inputs and settings and can be reused."""

    def photo(self, view: PhotoView, /) -> NDArray[np.uint8]:
        """Return (height, width, 3) RGB of a view at the view's size; OSError where it cannot be read."""

    def usable_pixels(self, view: PhotoView, /) -> NDArray[np.bool_] | None:
        """Return (height, width) which pixels of a photo at full size may be used; None if all may.

        The other pixels have the color of a usable pixel in `photo`. OSError where the mask cannot be read.
        """

    def recall(self, name: str, /) -> Mapping[str, NDArray[Any]] | None:
        """Return the arrays kept under a name; None if there are none."""

    def keep(self, name: str, /, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays under a name, replacing previous ones, complete or not at all.

        Args:
            name: of the group of arrays.
            arrays: by name.
        """
