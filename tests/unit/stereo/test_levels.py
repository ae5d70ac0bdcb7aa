"""Coarser depth maps fill what finer ones leave open."""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pytest

from sfm_app.settings import DepthSettings
from sfm_app.stereo import DepthEstimate, DepthMap, DepthTask, make_depth_maps_on_cpu, method, rank_neighbors
from sfm_app.stereo.method import fill_from_coarse, halve_views, open_share
from sfm_app.stereo.patch_match import fit_planes, plane_normals
from sfm_app.types import Rejected

CENTERS = [(-0.5, 0, 0), (0, 0, 0), (0.5, 0.1, 0), (0.1, 0.5, 0.05), (-0.2, -0.4, 0)]


@pytest.mark.parametrize("size", [(240, 180), (241, 179)])
def test_a_halved_view_sees_the_same_at_half_the_place(make_view, size):
    view = make_view((0.1, 0.2, 0), size=size, sample_px=0.0)

    small = view.halve(1)

    assert (small.width, small.height) == (120, size[1] // 2)
    assert (small.level, small.sample_px) == (1, 0.5)
    full, half = (at[:, :2] / at[:, 2:] for at in ((view.points @ v.R.T + v.t) @ v.K.T for v in (view, small)))
    np.testing.assert_allclose(half / [small.width, small.height], full / size, rtol=1e-12)
    assert [level[0].width for level in halve_views([view], 3)] == [size[0], 120, 60]


def maps_of(plane, view):
    return maps_of_depth(plane.depth(view), view)


def maps_of_depth(depth, view):
    return DepthMap(depth, plane_normals(fit_planes(depth), view))


@pytest.mark.parametrize("sample_px", [0.0, 0.5])
def test_holes_get_the_depth_of_the_plane_and_nothing_else_changes(plane, make_view, sample_px):
    view = make_view((0.1, 0.2, 0), sample_px=sample_px)
    small, whole = view.halve(1), maps_of(plane, view)
    coarse = maps_of(plane, small)
    coarse.depth[:, :20] = 0  # unknown there, too
    hole = np.zeros(whole.depth.shape, bool)
    hole[60:120, 10:150] = True
    fine = DepthMap(np.where(hole, np.float32(0), whole.depth), np.where(hole[..., None], np.float32(0), whole.normals))

    found = fill_from_coarse(fine, view, coarse, small, np.zeros(hole.shape, bool))

    np.testing.assert_array_equal(found.depth[~hole], whole.depth[~hole])
    filled = hole & (found.depth > 0)
    assert not found.depth[hole & (np.arange(240) < 39)].any()
    assert filled.sum() == (hole & (np.arange(240) >= 40)).sum()
    error = np.abs(found.depth / whole.depth - 1)[filled]
    assert 0 < error.max() < 2e-4  # the nearest depth without its slope would be 1e-3 off
    assert (np.einsum("nk,nk->n", found.normals[filled], whole.normals[filled]) > 0.999).all()


@dataclass
class Memory:
    """A store of noisy photos that show hardly anything."""

    plane: object
    contrast: float = 0.04
    estimates: dict = field(default_factory=dict)
    maps: dict = field(default_factory=dict)
    proposals: dict = field(default_factory=dict)

    def photo(self, view):
        full = replace(view, K=np.diag([2.0**view.level, 2.0**view.level, 1]) @ view.K, level=0,
                       width=view.width << view.level, height=view.height << view.level)  # fmt: skip
        rng = np.random.default_rng([ord(c) for c in view.name])
        shown = (
            128
            + self.contrast * (self.plane.photo(full).astype(float) - 128)
            + rng.normal(0, 2.0, (full.height, full.width))
        )
        return cv2.resize(np.round(shown).astype(np.uint8), (view.width, view.height), interpolation=cv2.INTER_AREA)

    def has(self, view, kind):
        kept = {"geometric": self.maps, "photometric": self.estimates, "proposed": self.proposals}
        return (view.name, view.level) in kept[kind]

    def read_estimate(self, view):
        return self.estimates[view.name, view.level]

    def read_depth(self, view, kind="photometric"):
        if kind == "proposed":
            return self.proposals[view.name, view.level]
        return (self.maps if kind == "geometric" else self.estimates)[view.name, view.level].depth

    def read_maps(self, view):
        return self.maps[view.name, view.level]

    def write_proposal(self, view, depth):
        self.proposals[view.name, view.level] = depth

    def write_estimate(self, view, estimate):
        self.estimates[view.name, view.level] = estimate

    def write_maps(self, view, maps):
        self.maps[view.name, view.level] = maps


def task_of(views, store, levels):
    def one_by_one(function, items, _):
        return [function(item) for item in items]

    options = DepthSettings(neighbors=4, levels=levels)
    return DepthTask(None, views, rank_neighbors(views, 4), options, store, one_by_one)


@pytest.mark.slow
def test_what_noise_hides_is_found_in_smaller_photos(plane, make_view):
    views = [make_view(center, name=f"{k}.jpg") for k, center in enumerate(CENTERS)]
    known = []
    for levels in (1, 2):
        store = Memory(plane)
        make_depth_maps_on_cpu(task_of(views, store, levels))
        depth = [store.maps[view.name, 0].depth if (view.name, 0) in store.maps else None for view in views]
        known.append(np.mean([0.0 if map_ is None else np.mean(map_ > 0) for map_ in depth]))
        errors = [np.abs(m / plane.depth(v) - 1)[m > 0] for m, v in zip(depth, views, strict=True) if m is not None]

    assert known[0] < 0.1
    assert 0.3 < known[1] < 0.8
    assert 1e-4 < np.median(np.concatenate(errors)) < 0.01
    assert np.percentile(np.concatenate(errors), 95) < 0.02


@pytest.mark.slow
def test_a_photo_that_nothing_confirms_at_full_size_has_the_depths_of_the_smaller_one(plane, make_view, monkeypatch):
    views, whole = [make_view(center, name=f"{k}.jpg") for k, center in enumerate(CENTERS)], method.confirm_depths
    reason = Rejected("no depth is confirmed by other photos")

    def confirm(view, *rest):
        return reason if view.level == 0 and view.name == "1.jpg" else whole(view, *rest)

    monkeypatch.setattr(method, "confirm_depths", confirm)
    for levels, expected in ((1, reason), (2, None)):
        store = Memory(plane, contrast=1.0)
        found = make_depth_maps_on_cpu(task_of(views, store, levels))

        assert found[1] == expected
        assert found[0] is None
    depth = store.maps["1.jpg", 0].depth
    assert 0.4 < np.mean(depth > 0) <= 1
    assert 1e-4 < np.median(np.abs(depth / plane.depth(views[1]) - 1)[depth > 0]) < 0.01


class Banded(Memory):
    """Photos with a bright and a dark band that show nothing else."""

    def photo(self, view):
        shown = self.plane.photo(view).clip(80, 160)
        shown[:, : view.width // 4], shown[:, -view.width // 4 :] = 240, 50
        return shown


def test_what_may_be_a_sky_is_not_filled(plane, make_view, monkeypatch):
    views = [make_view(center, name=f"{k}.jpg") for k, center in enumerate(CENTERS)]

    def confirm(view, *_):
        whole, known = plane.depth(view), np.ones((view.height, view.width), bool)
        known[:, : view.width // 4] = known[:, -view.width // 4 :] = view.level > 0
        return maps_of_depth(np.where(known, whole, np.float32(0)), view)

    monkeypatch.setattr(method, "match_depths", lambda view, *_: DepthEstimate(plane.depth(view), plane.depth(view)))
    monkeypatch.setattr(method, "confirm_depths", confirm)
    store = Banded(plane)
    make_depth_maps_on_cpu(task_of(views, store, 2))

    found = store.maps["1.jpg", 0].depth > 0
    assert not found[:, :60].any()
    assert found[:, 64:].all()


@pytest.mark.slow
@pytest.mark.parametrize(("contrast", "second"), [(0.04, True), (1.0, False)])
def test_a_second_level_comes_where_the_first_leaves_much_open(plane, make_view, monkeypatch, contrast, second):
    views = [make_view(0.3 * np.array(center), name=f"{k}.jpg") for k, center in enumerate(CENTERS)]
    store = Memory(plane, contrast=contrast)
    monkeypatch.setattr(method, "MOST_OPEN", 0.3)  # the borders of such small photos are a tenth of them

    make_depth_maps_on_cpu(task_of(views, store, levels=0))

    assert {level for _, level in store.estimates} == ({0, 1} if second else {0})
    assert {level for _, level in store.maps} == {0}


def test_what_is_black_or_may_be_sky_is_not_open(plane, make_view):
    view = make_view((0, 0, 0))
    photo, depth = Banded(plane).photo(view), plane.depth(view)
    known = np.ones(photo.shape, bool)
    known[:, :60] = known[:, 180:] = False
    estimate = DepthEstimate(np.where(known, depth, np.float32(0)), known.astype(np.float32))

    assert open_share(photo, estimate) == pytest.approx(0.25, abs=0.02)  # the dark band, not the bright one
    assert open_share(np.where(photo == 50, 10, photo).astype(np.uint8), estimate) < 0.02


class Door(Memory):
    """Photos of a plane with a plain door in the middle."""

    def photo(self, view):
        rays = self.plane._rays(view, 0.5)
        places = view.center + self.plane.depth(replace(view, sample_px=0.5))[..., None] * rays
        door = (np.abs(places[..., 0]) < 0.6) & (np.abs(places[..., 1]) < 0.5)
        return np.where(door, 90, self.plane.photo(view)).astype(np.uint8)


def test_a_photo_whose_planes_cannot_be_found_keeps_its_depths(plane, make_view, monkeypatch):
    views = [make_view(0.5 * np.array(center), name=f"{k}.jpg") for k, center in enumerate(CENTERS)]

    def fail(*_):
        raise np.linalg.LinAlgError("no convergence")

    monkeypatch.setattr(method, "match_depths", lambda view, *_: DepthEstimate(plane.depth(view), plane.depth(view)))
    monkeypatch.setattr(method, "confirm_depths", lambda view, *_: maps_of(plane, view))
    monkeypatch.setattr(method, "propose_planes", fail)
    store = Door(plane)

    assert make_depth_maps_on_cpu(task_of(views, store, 2)) == [None] * 5
    for view in views:
        np.testing.assert_array_equal(store.maps[view.name, 0].depth, maps_of(plane, view).depth)


@pytest.mark.parametrize("levels", [1, 2])
def test_a_door_of_which_no_photo_shows_more_than_the_frame_is_closed(plane, make_view, monkeypatch, levels):
    views = [make_view(0.5 * np.array(center), name=f"{k}.jpg") for k, center in enumerate(CENTERS)]
    store, holes = Door(plane), {}

    def confirm(view, photo, *_):
        known = photo != 90
        holes[view.name, view.level] = ~known
        return maps_of_depth(np.where(known, plane.depth(view), np.float32(0)), view)

    monkeypatch.setattr(method, "match_depths", lambda view, *_: DepthEstimate(plane.depth(view), plane.depth(view)))
    monkeypatch.setattr(method, "confirm_depths", confirm)
    task = task_of(views, store, levels)
    assert make_depth_maps_on_cpu(task) == [None] * 5

    before = {name: (maps.depth.copy(), maps.normals.copy()) for name, maps in store.maps.items()}
    for view in views:
        found, hole = store.maps[view.name, 0], holes[view.name, 0]
        low, high = ((0.0, 0.15), (0.8, 1.0))[levels - 1]
        assert low <= np.mean(found.depth[hole] > 0) < high
        filled = hole & (found.depth > 0)
        assert np.abs(found.depth / plane.depth(view) - 1)[filled].max(initial=0) < 1e-3
        slant = found.normals[filled] @ view.R @ plane.normal
        assert np.abs(slant + 1).max(initial=0) < 1e-3  # to the camera
    make_depth_maps_on_cpu(task)
    for name, (depth, normals) in before.items():
        np.testing.assert_array_equal(store.maps[name].depth, depth)
        np.testing.assert_array_equal(store.maps[name].normals, normals)
