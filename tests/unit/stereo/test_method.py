"""Depth maps on the CPU: resume, reasons of rejected photos, coarser levels."""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pytest

from sfm_app.settings import DepthSettings
from sfm_app.stereo import (
    DepthEstimate,
    DepthMap,
    DepthTask,
    confirm_depths,
    make_depth_maps_on_cpu,
    match_depths,
    method,
    rank_neighbors,
)
from sfm_app.stereo.method import Steps, fill_from_coarse, find_gaps, halve_views
from sfm_app.stereo.patch_match import fit_planes, plane_normals
from sfm_app.types import Rejected

CENTERS = [(-0.5, 0, 0), (0, 0, 0), (0.5, 0.1, 0), (0.1, 0.5, 0.05), (-0.2, -0.4, 0)]


@dataclass
class Memory:
    """A store in memory; a write beyond the `full`-th kills the run."""

    plane: object
    maps: dict = field(default_factory=lambda: {"photometric": {}, "geometric": {}, "closed": {}})
    written: list = field(default_factory=list)
    full: int = 100

    def photo(self, view):
        return self.plane.photo(view)

    def has(self, view, kind):
        return (view.name, view.level) in self.maps[kind]

    def read(self, view, kind):
        return self.maps[kind][view.name, view.level]

    def write(self, view, kind, content):
        if len(self.written) == self.full:
            raise KeyboardInterrupt
        self.written.append(view.name)
        self.maps[kind][view.name, view.level] = content

    def read_estimate(self, view):
        return self.read(view, "photometric")

    def read_maps(self, view):
        return self.read(view, "geometric")

    def read_depth(self, view, kind="photometric"):
        found = self.read(view, kind)
        return found if kind == "closed" else found.depth

    def write_estimate(self, view, estimate):
        self.write(view, "photometric", estimate)

    def write_maps(self, view, maps):
        self.write(view, "geometric", maps)

    def write_depth(self, view, depth, kind):
        self.write(view, kind, depth)


@dataclass
class Noisy(Memory):
    """Noisy photos with little contrast."""

    contrast: float = 0.04

    def photo(self, view):
        full = replace(view, K=np.diag([2.0**view.level, 2.0**view.level, 1]) @ view.K, level=0,
                       width=view.width << view.level, height=view.height << view.level)  # fmt: skip
        noise = np.random.default_rng([ord(c) for c in view.name]).normal(0, 2.0, (full.height, full.width))
        gray = np.round(128 + self.contrast * (self.plane.photo(full).astype(float) - 128) + noise)
        return cv2.resize(gray.astype(np.uint8), (view.width, view.height), interpolation=cv2.INTER_AREA)


class Banded(Memory):
    """Photos with a bright and a dark band without texture."""

    def photo(self, view):
        gray = self.plane.photo(view).clip(80, 160)
        gray[:, : view.width // 4], gray[:, -view.width // 4 :] = 240, 50
        return gray


@dataclass
class Door(Memory):
    """Photos of a plane with a bright plain door in the middle."""

    def photo(self, view):
        rays = self.plane._rays(view, 0.5)
        points = view.center + self.plane.depth(replace(view, sample_px=0.5))[..., None] * rays
        door = (np.abs(points[..., 0]) < 0.6) & (np.abs(points[..., 1]) < 0.5)
        return np.where(door, 240, self.plane.photo(view).clip(0, 200)).astype(np.uint8)


@pytest.fixture
def views(make_view):
    return [make_view(center, name=f"{k}.jpg") for k, center in enumerate(CENTERS)]


@pytest.fixture
def small_views(make_view):
    return [make_view(center, name=f"{k}.jpg", size=(160, 120)) for k, center in enumerate(CENTERS[:3])]


def task_of(views, store, levels=1, neighbors=4):
    def one_by_one(function, items, _):
        return [function(item) for item in items]

    options = DepthSettings(neighbors=neighbors, levels=levels)
    return DepthTask(None, views, rank_neighbors(views, 4), options, store, one_by_one)


def maps_of(depth, view):
    return DepthMap(depth, plane_normals(fit_planes(depth), view))


def true_steps(plane, confirm):
    """Steps that match every depth of the plane, and confirm as given."""
    return Steps(lambda view, *_: DepthEstimate(plane.depth(view), plane.depth(view)), confirm)


@pytest.mark.slow
def test_a_killed_run_resumes_at_the_same_photo(plane, small_views):
    whole, killed = Memory(plane), Memory(plane, full=2)
    assert make_depth_maps_on_cpu(task_of(small_views, whole, neighbors=2)) == [None, None, None]
    with pytest.raises(KeyboardInterrupt):
        make_depth_maps_on_cpu(task_of(small_views, killed, neighbors=2))
    assert killed.written == ["0.jpg", "1.jpg"]

    killed.full = 100
    assert make_depth_maps_on_cpu(task_of(small_views, killed, neighbors=2)) == [None, None, None]

    assert killed.written == ["0.jpg", "1.jpg", "2.jpg", "0.jpg", "1.jpg", "2.jpg"]
    for name, maps in whole.maps["geometric"].items():
        assert maps.depth.tobytes() == killed.maps["geometric"][name].depth.tobytes()
        assert np.mean(maps.depth > 0) > 0.3
    make_depth_maps_on_cpu(task_of(small_views, killed, neighbors=2))
    assert len(killed.written) == 6


@pytest.mark.slow
def test_an_unconfirmed_photo_has_a_reason_and_no_map(plane, small_views, make_view):
    other = make_view((0, 0, 0), name="other.jpg", turn=(0, 2.0, 0), size=(160, 120))
    store = Memory(plane)

    rejected = make_depth_maps_on_cpu(task_of([*small_views, other], store, neighbors=2))

    assert rejected == [None, None, None, Rejected("no photo shares enough points")]
    for kind in ("photometric", "geometric"):
        assert [name for name, _ in store.maps[kind]] == ["0.jpg", "1.jpg", "2.jpg"]
    assert all(0 < np.mean(maps.depth > 0) <= 1 for maps in store.maps["geometric"].values())


@pytest.mark.slow
@pytest.mark.parametrize("step", ["match", "confirm"])
def test_a_numerical_failure_is_the_reason_of_one_photo_only(plane, small_views, step):
    whole = {"match": match_depths, "confirm": confirm_depths}[step]

    def failing(view, *rest):
        if view.name == "2.jpg":
            raise np.linalg.LinAlgError("Singular matrix")
        return whole(view, *rest)

    rejected = make_depth_maps_on_cpu(task_of(small_views, Memory(plane), neighbors=2), Steps(**{step: failing}))

    assert rejected[2] == Rejected("the computation failed: Singular matrix")
    assert rejected[1] is None


@pytest.mark.parametrize("size", [(240, 180), (241, 179)])
def test_a_halved_view_projects_to_half_the_pixels(make_view, size):
    view = make_view((0.1, 0.2, 0), size=size, sample_px=0.0)

    small = view.halve(1)

    assert (small.width, small.height) == (120, size[1] // 2)
    assert (small.level, small.sample_px) == (1, 0.5)
    full, half = (at[:, :2] / at[:, 2:] for at in ((view.points @ v.R.T + v.t) @ v.K.T for v in (view, small)))
    np.testing.assert_allclose(half / [small.width, small.height], full / size, rtol=1e-12)
    assert [level[0].width for level in halve_views([view], 3)] == [size[0], 120, 60]


@pytest.mark.parametrize("sample_px", [0.0, 0.5])
def test_only_gaps_are_filled_along_the_coarse_plane(plane, make_view, sample_px):
    view = make_view((0.1, 0.2, 0), sample_px=sample_px)
    small, whole = view.halve(1), maps_of(plane.depth(view), view)
    coarse = maps_of(plane.depth(small), small)
    coarse.depth[:, :20] = 0  # a gap there, too
    hole = np.zeros(whole.depth.shape, bool)
    hole[60:120, 10:150] = True
    fine = DepthMap(np.where(hole, np.float32(0), whole.depth), np.where(hole[..., None], np.float32(0), whole.normals))

    maps = fill_from_coarse(fine, view, coarse, small, np.zeros(hole.shape, bool))

    np.testing.assert_array_equal(maps.depth[~hole], whole.depth[~hole])
    filled = hole & (maps.depth > 0)
    assert not maps.depth[hole & (np.arange(240) < 39)].any()
    assert filled.sum() == (hole & (np.arange(240) >= 40)).sum()
    error = np.abs(maps.depth / whole.depth - 1)[filled]
    assert 0 < error.max() < 2e-4  # the nearest depth without its slope would be 1e-3 off
    assert (np.einsum("nk,nk->n", maps.normals[filled], whole.normals[filled]) > 0.999).all()


@pytest.mark.slow
def test_smaller_photos_show_surfaces_below_the_noise(plane, views):
    shares, errors = [], []
    for levels in (1, 2):
        store = Noisy(plane)
        make_depth_maps_on_cpu(task_of(views, store, levels))
        empty = DepthMap.unknown(views[0])
        depths = [store.maps["geometric"].get((view.name, 0), empty).depth for view in views]
        shares.append(np.mean([depth > 0 for depth in depths]))
        errors = [np.abs(z / plane.depth(view) - 1)[z > 0] for z, view in zip(depths, views, strict=True)]

    assert shares[0] < 0.1
    assert 0.3 < shares[1] < 0.8
    assert 1e-4 < np.median(np.concatenate(errors)) < 0.01
    assert np.percentile(np.concatenate(errors), 95) < 0.02


@pytest.mark.slow
def test_a_photo_rejected_at_full_size_has_the_depths_of_the_smaller_one(plane, views):
    reason = Rejected("no depth is confirmed by other photos")

    def confirm(view, *rest):
        return reason if view.level == 0 and view.name == "1.jpg" else confirm_depths(view, *rest)

    for levels, expected in ((1, reason), (2, None)):
        store = Noisy(plane, contrast=1.0)
        rejected = make_depth_maps_on_cpu(task_of(views, store, levels), Steps(confirm=confirm))

        assert rejected[1] == expected
        assert rejected[0] is None
    depth = store.maps["geometric"]["1.jpg", 0].depth
    assert 0.4 < np.mean(depth > 0) <= 1
    assert 1e-4 < np.median(np.abs(depth / plane.depth(views[1]) - 1)[depth > 0]) < 0.01


def test_a_possible_sky_is_not_filled(plane, views):
    def confirm(view, *_):
        known = np.ones((view.height, view.width), bool)
        known[:, : view.width // 4] = known[:, -view.width // 4 :] = view.level > 0
        return maps_of(np.where(known, plane.depth(view), np.float32(0)), view)

    store = Banded(plane)
    make_depth_maps_on_cpu(task_of(views, store, 2), true_steps(plane, confirm))

    known = store.maps["geometric"]["1.jpg", 0].depth > 0
    assert not known[:, :60].any()
    assert known[:, 64:].all()


@pytest.mark.slow
@pytest.mark.parametrize(("contrast", "second"), [(0.04, True), (1.0, False)])
def test_a_second_level_follows_many_gaps(plane, make_view, monkeypatch, contrast, second):
    views = [make_view(0.3 * np.array(center), name=f"{k}.jpg") for k, center in enumerate(CENTERS)]
    store = Noisy(plane, contrast=contrast)
    # the borders of such small photos are a tenth of them
    monkeypatch.setattr(method, "OPTIONS", replace(method.OPTIONS, most_open=0.3))

    make_depth_maps_on_cpu(task_of(views, store, levels=0))

    assert {level for _, level in store.maps["photometric"]} == ({0, 1} if second else {0})
    assert {level for _, level in store.maps["geometric"]} == {0}


def test_black_pixels_and_a_possible_sky_are_no_gaps(plane, make_view):
    view = make_view((0, 0, 0))
    photo, depth = Banded(plane).photo(view), plane.depth(view)
    known = np.ones(photo.shape, bool)
    known[:, :60] = known[:, 180:] = False
    estimate = DepthEstimate(np.where(known, depth, np.float32(0)), known.astype(np.float32))

    gaps = find_gaps(photo, estimate, estimate.depth)
    black = find_gaps(np.where(photo == 50, 10, photo).astype(np.uint8), estimate, estimate.depth)

    assert gaps.open_share(gaps.areas.blank) == pytest.approx(0.25, abs=0.02)  # the dark band, not the bright one
    assert black.open_share(black.areas.blank) < 0.02
    assert gaps.open_share(np.zeros_like(gaps.areas.blank)) == pytest.approx(0.5, abs=0.02)  # a wall is a gap


@pytest.mark.parametrize(("apart", "closed"), [(0.5, False), (2.5, True)])
def test_a_bright_door_is_closed_if_other_photos_show_no_sky_in_its_direction(plane, make_view, apart, closed):
    views = [make_view(apart * np.array(center), name=f"{k}.jpg") for k, center in enumerate(CENTERS)]
    store = Door(plane)

    def confirm(view, photo, *_):
        known = (photo != 240) | (view.level > 0)
        return maps_of(np.where(known, plane.depth(view), np.float32(0)), view)

    assert make_depth_maps_on_cpu(task_of(views, store, 2), true_steps(plane, confirm)) == [None] * 5

    for view in views:
        inside = cv2.erode((store.photo(view) == 240).view(np.uint8), np.ones((9, 9))) > 0
        assert inside.any()
        assert np.mean(store.maps["geometric"][view.name, 0].depth[inside] > 0) == pytest.approx(float(closed), abs=0.1)
