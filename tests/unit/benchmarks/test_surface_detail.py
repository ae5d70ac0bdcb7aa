"""The figures of fine detail are 100 % for the truth, and fall where something is missing, rounded or invented."""

import numpy as np
import pytest

from benchmarks.surface.rendered import detail
from benchmarks.surface.rendered.detail import detail_scores
from benchmarks.synthetic.detail_scenes import straight, tube
from benchmarks.synthetic.houses import assemble
from sfm_app.synthetic.cameras import Views, look_at, make_camera
from sfm_app.synthetic.compare import scene_size
from sfm_app.synthetic.photo_folder import Truth
from sfm_app.synthetic.scenes import LIMESTONE
from sfm_app.synthetic.shapes import Body, SyntheticScene, box, ground
from sfm_app.types import Surface

ROD = straight((0.9, 0.1, 0.0), (0.9, 1.2, 0.0), 0.01)
FLOOR, BLOCK, BAR = ground((-1.5, 1.5), (-1.5, 1.5), 0.001), box(0.8, 0.6, 0.6).move((0.0, 0.05, 0.0)), tube(ROD)
SCENE = SyntheticScene("block", tuple(Body(shape, LIMESTONE) for shape in (FLOOR, BLOCK, BAR)), thin=(ROD,))


@pytest.fixture(scope="module")
def truth():
    """Four photos of a block and a rod, from above and from low on."""
    camera = make_camera(200, 150, center=(0.5, 0.5))
    eyes = ((0.5, 2.0, 4.0), (-0.5, 1.8, 4.0), (0.0, 1.3, 4.5), (1.0, 1.3, 4.3))
    views = Views.from_poses(camera, [look_at(np.array(eye), np.array([0.2, 0.4, 0.0])) for eye in eyes])
    return Truth(dict(views.cameras), dict(views.cam_from_world), SCENE.vertices, SCENE.faces)


@pytest.fixture(autouse=True)
def fewer_samples(monkeypatch):
    monkeypatch.setattr(detail, "SAMPLES", 20_000)


def scores(truth, *shapes):
    whole = assemble(shapes)
    surface = Surface(whole.vertices, whole.faces, np.zeros((len(whole.vertices), 3), np.uint8))
    return detail_scores(surface, truth.centers, truth, SCENE)


def test_the_truth_has_all_its_detail(truth):
    found = scores(truth, FLOOR, BLOCK, BAR)
    assert found["accuracy 0.05 %"] == found["completeness 0.05 %"] == found["F 0.05 %"] == 100.0
    assert (found["flakes %"], found["thin things %"], found["edges within 0.1 %"]) == (0.0, 100.0, 100.0)
    assert found["edges: median %"] < 1e-3 and found["ground at a low angle %"] == 100.0


def test_a_missing_rod_a_missing_floor_and_a_flake_are_seen(truth):
    flake = box(0.5, 0.01, 0.5).move((0.0, 1.5, 0.0))
    found = scores(truth, BLOCK, flake)
    assert found["thin things %"] < 30.0 and found["ground at a low angle %"] < 15.0
    assert 10.0 < found["flakes %"] < 50.0 and found["completeness 0.4 %"] < 70.0


def test_a_smaller_block_has_rounded_edges(truth):
    off = 0.004 * scene_size(truth)
    smaller = box(0.8 - 2 * off, 0.6 - off, 0.6 - 2 * off).move((0.0, 0.05, 0.0))
    found = scores(truth, FLOOR, smaller, BAR)
    assert 100 * 0.004 * np.sqrt(2) == pytest.approx(found["edges: median %"], rel=0.1)
    assert found["edges within 0.1 %"] < 10.0 and found["accuracy 0.1 %"] < 100.0


def test_an_empty_mesh_has_no_figures(truth):
    empty = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8))
    assert detail_scores(empty, truth.centers, truth, SCENE) == {}
