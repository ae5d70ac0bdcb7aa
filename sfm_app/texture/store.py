"""Where photos come from, and what outlasts a killed run."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sfm_app.texture.views import PhotoView


class Store(Protocol):
    """Photos, and arrays under a name; what is kept comes from the same inputs and settings and can be used again."""

    def photo(self, view: PhotoView, /) -> NDArray[np.uint8]:
        """Return (height, width, 3) RGB of a view at the view's size; OSError where it cannot be read."""

    def used(self, view: PhotoView, /) -> NDArray[np.bool_] | None:
        """Return (height, width) which pixels of a photo at full size may be used; None where all may.

        Photos show nothing of the others: these have the color of one that may be used. OSError as above.
        """

    def recall(self, name: str, /) -> Mapping[str, NDArray[Any]] | None:
        """Return what was kept under a name, if anything was."""

    def keep(self, name: str, /, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays under a name in place of what was there, complete or not at all.

        Args:
            name: of the group.
            arrays: by name.
        """
