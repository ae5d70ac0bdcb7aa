from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from benchmarks.surface import rivals
from benchmarks.surface.pyarchinit_worker import depth_width
from sfm_app.synthetic.cameras import look_at, make_camera
from sfm_app.synthetic.render import Picture, PreparedModel, render_model

CORNERS = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
FACES = np.array([[0, 3, 2], [0, 2, 1]])
UV = (CORNERS[FACES, :2] + 1.0) / 2.0


def row(settings, seconds, coverage):
    return {"photos": "box", "settings": settings, rivals.TOGETHER: seconds, "coverage %": coverage}


def test_the_page_of_the_rival_is_read_from_its_bottom_left_corner(tmp_path):
    np.savez(tmp_path / "mesh.npz", vertices=CORNERS, faces=FACES, uv=UV)
    pixels = np.full((64, 64, 3), 255, np.uint8)
    pixels[:32, :, 1:] = 0
    Image.fromarray(pixels).save(tmp_path / "page.png")
    model = PreparedModel(rivals.read_model(tmp_path / "mesh.npz", tmp_path / "page.png"))

    seen = render_model(model, make_camera(80, 80), look_at(np.array([0.0, 0.0, 3.0]), np.zeros(3)))

    at_top, at_bottom = seen.colors[30, 40], seen.colors[50, 40]
    assert seen.covered[30, 40] and seen.covered[50, 40]
    assert (tuple(at_top), tuple(at_bottom)) == ((255, 0, 0), (255, 255, 255))


def test_quoted_figures_are_told_apart_from_measured_ones():
    text = rivals.page([row("sfm-app", 90, 80.0), row("the rival", 30, 70.0)], [])
    measured, quoted = text.split("## Quoted")
    assert "OpenMVS" not in measured
    assert "not rerun here" in quoted and "before RefineMesh" in quoted


@pytest.mark.parametrize("widths", [(1000,), (384, 400)])
def test_the_width_of_depth_maps(tmp_path, widths):
    folder = tmp_path / "stereo" / "depth_maps"
    folder.mkdir(parents=True)
    for width in widths:
        (folder / f"{width}.bin").write_bytes(f"{width}&2&1&".encode("ascii") + bytes(8 * width))
    assert depth_width(tmp_path) == max(widths)


def test_the_better_program_is_named_for_each_figure():
    found = rivals.leaders([row("sfm-app", 90, 80.0), row("quick", 30, 60.0), row("fine", 200, 70.0)])
    assert [(one["ahead"], one["its settings"]) for one in found] == [(rivals.RIVAL, "quick"), (rivals.OURS, "fine")]


def test_all_models_are_compared_on_the_pixels_that_each_covers(monkeypatch):
    """A model that covers half of the photo, with wrong colors outside of the other one."""
    photo = np.random.default_rng(0).integers(0, 255, (80, 80, 3)).astype(np.uint8)
    left = np.zeros((80, 80), bool)
    left[:, :40] = True
    wrong = np.where(left[..., None], photo, 255 - photo)
    pictures = [Picture(photo, left), Picture(wrong, np.ones_like(left))]
    monkeypatch.setattr(rivals, "placed_photos", lambda *_: {"a": None})
    monkeypatch.setattr(rivals, "placed_photo", lambda *_: SimpleNamespace(name="a", pixels=photo))
    monkeypatch.setattr(rivals, "render_view", lambda number, *_: pictures[number])
    half, whole = rivals.compare_photos(None, [0, 1])
    assert (half["coverage %"], whole["coverage %"]) == (50, 100)
    assert whole["PSNR dB"] < 20 < whole["PSNR dB common"] == half["PSNR dB common"]
