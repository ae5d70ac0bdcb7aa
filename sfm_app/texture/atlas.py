"""All pages of a texture while photos are painted on them; what is on them is kept now and then."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from threading import Lock

import numpy as np

from sfm_app.texture.painting import Canvas
from sfm_app.texture.store import Store

KEPT = "pages"
EVERY_S = 10.0
"""A killed run loses at most the photos of the last so many seconds."""
MOST_OF_THE_TIME = 0.05
"""Share of the time that goes into keeping: large pages are kept less often."""


class Pages:
    """Canvases with the sums of the photos; these are whole numbers, so the order of the photos does not matter."""

    def __init__(self, canvases: Sequence[Canvas], photos: int, store: Store) -> None:
        """Fill empty canvases with what a killed run has kept."""
        self.canvases, self.has = canvases, np.zeros(photos, np.bool_)
        self._store, self._lock = store, Lock()
        kept = store.recall(KEPT)
        if kept is not None:
            self.has[:] = kept["has"]
            for number, page in enumerate(canvases):
                page.total[:] = kept[f"page{number}"]
        self._due_s = time.monotonic() + EVERY_S

    @contextmanager
    def painting(self, photo: int) -> Iterator[Sequence[Canvas]]:
        """Provide the canvases, for one photo at a time; afterwards they have it."""
        with self._lock:
            yield self.canvases
            self.has[photo] = True
            if time.monotonic() >= self._due_s:
                self._keep()

    def _keep(self) -> None:
        start = time.monotonic()
        totals = {f"page{number}": page.total for number, page in enumerate(self.canvases)}
        self._store.keep(KEPT, {"has": self.has, **totals})
        end = time.monotonic()
        self._due_s = end + max(EVERY_S, (end - start) / MOST_OF_THE_TIME)
