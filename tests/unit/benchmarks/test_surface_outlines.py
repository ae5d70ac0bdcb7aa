"""The figures of outlines are perfect for the truth, and as large as a known hole, shift, fringe or speckle."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.surface.outlines import border_scores, picture_scores, read_model, silhouette_scores
from benchmarks.surface.photos import PlacedPhoto, render_view
from sfm_app.colmap.backend import pycolmap
from sfm_app.formats.meshes import write_ply
from sfm_app.synthetic.cameras import Views, make_camera, pixel_rays
from sfm_app.synthetic.photo_folder import Truth
from sfm_app.synthetic.render import PreparedModel
from sfm_app.synthetic.shapes import box
from sfm_app.types import Surface
from sfm_app.types.scene import camera_center
from sfm_app.types.surface import Model

CAMERA = make_camera(240, 200, center=(0.5, 0.5))
FOCAL, SIDE, CELL = CAMERA.K[0, 0], 1.6, 0.05
AWAY = 2.8
"""Distance of the cameras from the front of the box: its side is 144 pixels, a cell 4.5."""
PIXEL = AWAY / FOCAL
"""Size of a pixel on the front of the box, in scene units."""
TURN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
VIEWS = Views.from_poses(
    CAMERA,
    [  # all look along -z
        np.column_stack([np.diag([1.0, -1.0, -1.0]), [-x, y, AWAY + SIDE / 2]])
        for x, y in ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1), (-0.07, -0.07))
    ],
)


def block(*, cells=lambda x, _y: x < np.inf, shift=(0.0, 0.0), dark=lambda x, _y: x > np.inf):
    """A box around the origin whose front keeps some of its faces, and has dark ones; all others are bright."""
    shape = box(SIDE, SIDE, SIDE, spacing=CELL)
    vertices = shape.vertices - [0.0, SIDE / 2, 0.0]
    middle = vertices[shape.faces].mean(axis=1)
    front = middle[:, 2] > SIDE / 2 - 1e-6
    x, y, _ = middle.T
    faces = shape.faces[~front | cells(x, y)]
    corners = vertices[faces].reshape(-1, 3)  # vertices of their own keep colors apart
    middle, front = middle[~front | cells(x, y)], front[~front | cells(x, y)]
    bright = 140.0 + 50.0 * np.sin(3.0 * corners[:, 0]) * np.cos(2.0 * corners[:, 1])
    gray = np.where(np.repeat(front & dark(*middle.T[:2]), 3), bright - 60.0, bright)
    colors = np.repeat(gray.astype(np.uint8)[:, None], 3, axis=1)
    moved = corners + np.array([*shift, 0.0]) * PIXEL
    return Model(Surface(moved, np.arange(len(corners)).reshape(-1, 3), colors))


@pytest.fixture(scope="module")
def photos():
    """Photos of the whole box before a wall of its color."""
    camera = pycolmap.Camera(
        model="PINHOLE", width=CAMERA.width, height=CAMERA.height, params=[FOCAL, CAMERA.K[1, 1], *CAMERA.K[:2, 2]]
    )
    whole, found = PreparedModel(block()), []
    for name, pose in VIEWS.cam_from_world.items():
        rays = (pixel_rays(CAMERA) @ pose[:, :3]).reshape(CAMERA.height, CAMERA.width, 3)
        photo = PlacedPhoto(name, np.zeros(()), camera_center(pose), rays, camera, pose)
        picture = render_view(whole, photo).with_background((140, 140, 140))
        found.append(replace(photo, pixels=np.clip(0.8 * picture + 20.0, 0, 255).astype(np.uint8)))
    return found


def scores(model, photos):
    prepared = PreparedModel(model)
    return border_scores(prepared, photos) | picture_scores(prepared, photos)


def test_a_closed_box_has_nothing_to_complain_about(photos):
    found = scores(block(), photos)
    assert set(found.values()) == {0.0}


def test_a_square_hole_is_as_long_as_its_sides(photos):
    found = scores(block(cells=lambda x, y: np.maximum(abs(x), abs(y)) > 4 * CELL), photos)
    side_px = 8 * CELL / PIXEL
    assert found["holes"] == 1 and found["border edges"] == 4 * 8
    assert found["borders, widths"] == pytest.approx(4 * side_px / CAMERA.width, rel=0.05)
    assert found["largest hole px"] == pytest.approx(side_px, rel=0.05)


def test_borders_of_which_two_photos_know_are_nobodys_fault(photos):
    found = border_scores(PreparedModel(block(cells=lambda x, y: np.maximum(abs(x), abs(y)) > 4 * CELL)), photos[:2])
    assert (found["borders, widths"], found["holes"], found["border edges"]) == (0.0, 0, 32)


def sheet(**options):
    """The front of the box alone."""
    model = block(**options)
    surface = model.surface
    front = surface.vertices[surface.faces].min(axis=1)[:, 2] > SIDE / 2 - 1e-6
    return replace(model, surface=replace(surface, faces=surface.faces[front]))


def test_a_patch_has_a_border_but_is_no_hole(photos):
    found = border_scores(PreparedModel(sheet()), photos)
    assert found["holes"] == 0
    assert found["borders, widths"] == pytest.approx(4 * SIDE / PIXEL / CAMERA.width, rel=0.05)


def test_a_narrow_gap_is_open_and_a_wide_one_may_show_the_sky(photos):
    narrow, wide = (
        scores(sheet(cells=lambda x, y, half=half: np.maximum(abs(x), abs(y) / 4) > half), photos)
        for half in (CELL, 2 * CELL)  # 9 pixels by 36, and 18 by 72
    )
    band, open_px = 4 * (4 * SIDE / PIXEL - 16) + 4 * 2 * (9 + 36) + 64, 9 * 36 - 3 * 30
    assert narrow["open %"] == pytest.approx(100 * open_px / (band + open_px), rel=0.05)
    assert wide["open %"] < narrow["open %"] / 2, "its corners"
    assert narrow["off %"] == wide["off %"] == 0.0


@pytest.mark.parametrize("wide", [1, 2])
def test_a_dark_fringe_counts_by_its_area(photos, wide):
    # columns of cells at the left edge, of which a band of 4 pixels belongs to the outline
    found = scores(block(dark=lambda x, _y: x < -SIDE / 2 + wide * CELL), photos)
    side, strip, band = SIDE / PIXEL, wide * CELL / PIXEL, 4
    ring = side**2 - (side - 2 * band) ** 2
    assert found["off %"] == pytest.approx(100 * (band * side + 2 * band * (strip - band)) / ring, rel=0.05)
    assert found["open %"] == 0.0 and found["speckles per MP"] == 0.0, "it is too large to be a speckle"
    assert found["wrong anywhere %"] == pytest.approx(100 * wide * CELL / SIDE, rel=0.1)


def test_a_speckle_is_small_and_clearly_wrong(photos):
    one = scores(block(dark=lambda x, y: np.maximum(abs(x - 0.4), abs(y)) < 0.9 * CELL), photos)
    assert one["speckles per MP"] == 0.0 and one["wrong anywhere %"] > 0.0, "9 pixels by 9 are a wrong part"
    few = scores(block(dark=lambda x, y: (abs(abs(x) - 0.425) < CELL / 2) & (abs(y - 0.425) < CELL / 2)), photos)
    assert few["speckles per MP"] == pytest.approx(2e6 * (PIXEL / SIDE) ** 2, rel=0.02)
    assert few["off %"] == 0.0, "far from outlines"


TRUTH = Truth(dict(VIEWS.cameras), dict(VIEWS.cam_from_world), block().surface.vertices, block().surface.faces)


@pytest.mark.parametrize(("shift", "low", "high"), [(0.0, 100.0, 100.0), (0.8, 99.0, 100.0), (3.0, 0.0, 10.0)])
def test_silhouettes_are_right_within_a_pixel(photos, shift, low, high):
    found = silhouette_scores(block(shift=(shift, shift)).surface, photos, TRUTH)
    assert low <= found["silhouettes: F %"] <= high


def test_a_missing_half_costs_recall_and_its_border_precision(photos):
    found = silhouette_scores(sheet(cells=lambda x, _y: x < 0.0).surface, photos, TRUTH)
    assert found["silhouettes: recall %"] == pytest.approx(50.0, abs=3.0)
    assert found["silhouettes: precision %"] == pytest.approx(100 * 2 / 3, abs=3.0)


def test_a_model_without_texture_is_read_from_its_ply_into_the_frame_of_the_cameras(tmp_path):
    model = block()
    moved = replace(model.surface, vertices=2.0 * model.surface.vertices @ TURN.T + [1.0, 2.0, 3.0])
    (tmp_path / "model.ply").write_bytes(write_ply(Model(moved), "model")["model.ply"])
    frame = {"scale": 2.0, "R": TURN.tolist(), "t": [1.0, 2.0, 3.0], "unit": "m", "deviation": None, "source": ""}
    (tmp_path / "scale.json").write_text(json.dumps(frame | {"evidence": [], "contradictions": [], "place": None}))
    found = read_model(tmp_path).surface
    assert np.allclose(found.vertices, model.surface.vertices, atol=1e-5)
    assert np.array_equal(found.faces, model.surface.faces) and np.array_equal(found.colors, model.surface.colors)
