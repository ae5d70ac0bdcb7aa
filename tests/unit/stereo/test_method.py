"""The CPU's way to make depth maps: what is there is not made again, what fails has a reason."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from sfm_app.settings import DepthSettings
from sfm_app.stereo import DepthTask, make_depth_maps_on_cpu, method, rank_neighbors
from sfm_app.types import Rejected

pytestmark = pytest.mark.slow


@dataclass
class Memory:
    """A store that notes what is written."""

    plane: object
    estimates: dict = field(default_factory=dict)
    maps: dict = field(default_factory=dict)
    written: list = field(default_factory=list)
    full: int = 100

    def photo(self, view):
        return self.plane.photo(view)

    def has(self, view, kind):
        return view.name in self.maps if kind == "geometric" else (view.name, view.level) in self.estimates

    def read_estimate(self, view):
        return self.estimates[view.name, view.level]

    def read_depth(self, view):
        return self.estimates[view.name, view.level].depth

    def write_estimate(self, view, estimate):
        if len(self.written) == self.full:
            raise KeyboardInterrupt
        self.written.append(view.name)
        self.estimates[view.name, view.level] = estimate

    def write_maps(self, view, maps):
        self.written.append(view.name)
        self.maps[view.name] = maps


@pytest.fixture(scope="module")
def views(make_view):
    centers = [(-0.5, 0, 0), (0, 0, 0), (0.5, 0.1, 0)]
    return [make_view(center, name=f"{k}.jpg", size=(160, 120)) for k, center in enumerate(centers)]


def task_for(views, store):
    def one_by_one(function, items, _):
        return [function(item) for item in items]

    return DepthTask(None, views, rank_neighbors(views, 4), DepthSettings(neighbors=2, levels=1), store, one_by_one)


def test_a_killed_run_goes_on_with_the_photo_it_stopped_at(plane, views):
    whole, killed = Memory(plane), Memory(plane, full=2)
    assert make_depth_maps_on_cpu(task_for(views, whole)) == [None, None, None]
    with pytest.raises(KeyboardInterrupt):
        make_depth_maps_on_cpu(task_for(views, killed))
    assert killed.written == ["0.jpg", "1.jpg"]

    killed.full = 100
    assert make_depth_maps_on_cpu(task_for(views, killed)) == [None, None, None]

    assert killed.written == ["0.jpg", "1.jpg", "2.jpg", "0.jpg", "1.jpg", "2.jpg"]
    for name, maps in whole.maps.items():
        assert maps.depth.tobytes() == killed.maps[name].depth.tobytes()
        assert np.mean(maps.depth > 0) > 0.3
    make_depth_maps_on_cpu(task_for(views, killed))
    assert len(killed.written) == 6


def test_a_photo_that_nothing_confirms_has_a_reason_and_no_map(plane, views, make_view):
    stranger = make_view((0, 0, 0), name="stranger.jpg", turn=(0, 2.0, 0), size=(160, 120))
    store = Memory(plane)

    found = make_depth_maps_on_cpu(task_for([*views, stranger], store))

    assert found == [None, None, None, Rejected("no photo shares enough points")]
    assert ("stranger.jpg", 0) not in store.estimates
    assert "stranger.jpg" not in store.maps
    assert all(0 < np.mean(maps.depth > 0) <= 1 for maps in store.maps.values())


@pytest.mark.parametrize("step", ["match_depths", "confirm_depths"])
def test_a_photo_whose_numbers_fail_has_a_reason_and_the_others_their_maps(plane, views, monkeypatch, step):
    whole = getattr(method, step)

    def failing(view, *rest):
        if view.name == "2.jpg":
            raise np.linalg.LinAlgError("Singular matrix")
        return whole(view, *rest)

    monkeypatch.setattr(method, step, failing)

    found = make_depth_maps_on_cpu(task_for(views, Memory(plane)))

    assert found[2] == Rejected("the computation failed: Singular matrix")
    assert found[1] is None
