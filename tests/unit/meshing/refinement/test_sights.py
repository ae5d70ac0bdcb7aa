"""Each photo is drawn once while there is room, and a failure reaches everyone who waits for it."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sfm_app.meshing import refinement
from sfm_app.meshing.agreement import Raster, Sight
from sfm_app.meshing.refinement import Sights


def drawn(made, seconds=0.0):
    def look(number):
        time.sleep(seconds)
        made.append(number)
        return Sight(None, Raster(np.full((10, 10), number, np.float32), np.zeros((10, 10), np.int32)))

    return Sights(look)


def test_many_threads_that_ask_at_once_get_the_same_photo():
    made = []
    kept = drawn(made, seconds=0.05)
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda _: kept[3], range(8)))

    assert made == [3] and all(one is found[0] for one in found)


def test_the_photo_that_was_not_used_longest_is_dropped(monkeypatch):
    monkeypatch.setattr(refinement, "MOST_PX", 200)
    made = []
    kept = drawn(made)
    for number in (0, 1, 0, 2, 0, 1):
        assert kept[number].raster.depth[0, 0] == number

    assert made == [0, 1, 2, 1]


def test_a_failure_is_raised_again():
    def fail(number):
        raise ValueError(f"photo {number}")

    kept = Sights(fail)
    for _ in range(2):
        with pytest.raises(ValueError, match="photo 5"):
            kept[5]
