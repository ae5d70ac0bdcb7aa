"""The pages of a texture while photos are painted on them, with periodic checkpoints."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from threading import Lock

import numpy as np

from sfm_app.texture.painting import Canvas
from sfm_app.texture.store import Store

GROUP_NAME = "pages"
EVERY_S = 10.0
"""Shortest time between checkpoints, in seconds; a killed run loses the photos since the last one."""
MOST_OF_THE_TIME = 0.05
"""Largest share of the time spent on checkpoints; large pages are saved less often."""


class Pages:
    """Canvases with sums over photos; sums of integers do not depend on the order of the photos."""

    def __init__(self, canvases: Sequence[Canvas], photos: int, store: Store, block: int = 0) -> None:
        """Fill empty canvases from the checkpoint of a killed run, if it was at this block."""
        self.canvases, self.has = canvases, np.zeros(photos, np.bool_)
        self._store, self._lock, self._block = store, Lock(), block
        kept = store.recall(GROUP_NAME)
        if kept is not None and kept.get("block") == block:
            self.has[:] = kept["has"]
            for number, page in enumerate(canvases):
                page.total[:] = kept[f"page{number}"]
        self._due_s = time.monotonic() + EVERY_S

    @contextmanager
    def lock_canvases(self, photo: int) -> Iterator[Sequence[Canvas]]:
        """Provide the canvases to one photo at a time, and mark it as painted afterwards."""
        with self._lock:
            yield self.canvases
            self.has[photo] = True
            if time.monotonic() >= self._due_s:
                self._keep()

    def _keep(self) -> None:
        start = time.monotonic()
        totals = {f"page{number}": page.total for number, page in enumerate(self.canvases)}
        self._store.keep(GROUP_NAME, {"block": np.array(self._block), "has": self.has, **totals})
        end = time.monotonic()
        self._due_s = end + max(EVERY_S, (end - start) / MOST_OF_THE_TIME)
