"""Keep the photos that were used last, with the surface in them: each is drawn once, and memory stays bounded."""

from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from threading import Lock

from sfm_app.meshing.refinement.agreement import Sight

MOST_PX = 100_000_000
"""Pixels of the photos that are kept: 2 GB. By the memory that a run may have."""


class Sights:
    """Photos by their number, made when they are asked for first."""

    def __init__(self, look: Callable[[int], Sight]) -> None:
        self._look, self._lock = look, Lock()
        self._kept = OrderedDict[int, Future[Sight]]()

    def __getitem__(self, number: int) -> Sight:
        with self._lock:
            known = self._kept.get(number)
            if known is None:
                self._kept[number] = mine = Future[Sight]()
            else:
                self._kept.move_to_end(number)
        if known is not None:
            return known.result()
        try:
            mine.set_result(self._look(number))
        except BaseException as error:
            mine.set_exception(error)
            raise
        self._drop_oldest()
        return mine.result()

    def _drop_oldest(self) -> None:
        with self._lock:
            done = [(key, one.result()) for key, one in self._kept.items() if one.done() and not one.exception()]
            pixels = sum(sight.raster.depth.size for _, sight in done)
            for key, sight in done[:-1]:
                if pixels <= MOST_PX:
                    break
                pixels -= sight.raster.depth.size
                del self._kept[key]
