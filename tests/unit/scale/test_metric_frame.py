"""The frame of exported files: what is moved into it stays the same scene."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sfm_app.frame.scale import MetricFrame, ScaleEvidence, move_model
from sfm_app.frame.sighted_points import layout_scale, unrotate_pixels
from sfm_app.geometry.poses import Similarity
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.types import Photo

FRAME = MetricFrame(
    Similarity(3.5, axis_rotation(np.array([2.0, 6.0, 3.0]) / 7.0, 40.0), np.array([1.0, -2.0, 0.5])),
    0.001,
    "marker aruco-4x4 3",
    (ScaleEvidence("marker aruco-4x4 3", 3.5, 0.001, 4),),
    ("marker aruco-4x4 5 contradicts the 3 others",),
    "EPSG:32632",
    (500_000.0, 4_649_000.0, 320.0),
)


def test_it_is_read_back_as_it_was_written():
    again = MetricFrame.from_dict(json.loads(json.dumps(FRAME.to_dict())))
    assert again.to_dict() == FRAME.to_dict()
    assert again.is_metric and again.changes


def test_a_frame_that_changes_nothing_still_says_so_when_read_back():
    again = MetricFrame.from_dict(json.loads(json.dumps(MetricFrame().to_dict())))
    assert not again.changes and not again.is_metric


def test_moved_cameras_see_moved_points_where_they_saw_them(textured_ball):
    moved = move_model(textured_ball, FRAME.from_model)
    for before, after in zip(textured_ball.cameras, moved.cameras, strict=True):
        old, new = (
            points @ pose[:, :3].T + pose[:, 3]
            for points, pose in (
                (textured_ball.surface.vertices, before.cam_from_world),
                (moved.surface.vertices, after.cam_from_world),
            )
        )
        assert np.allclose(new, 3.5 * old, atol=1e-9)
    assert np.array_equal(moved.surface.faces, textured_ball.surface.faces)


def test_marks_are_of_the_file_at_its_full_size(tmp_path):
    Image.new("RGB", (120, 80)).save(tmp_path / "a.jpg")
    small = Photo("a.jpg", 60, 40, "one camera", needs_copy=True)
    assert layout_scale(small, tmp_path) == 0.5
    assert layout_scale(replace(small, needs_copy=False), tmp_path) == 1.0
    assert layout_scale(replace(small, name="gone.jpg"), tmp_path) == 1.0


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_pixels_of_the_upright_photo_are_found_as_it_is_laid_out(turn):
    laid_out = np.zeros((40, 60), np.uint8)
    laid_out[11, 47] = 255
    upright = np.asarray(Image.fromarray(laid_out).rotate(-turn, expand=True))
    row, column = np.argwhere(upright)[0]
    photo = Photo("a.jpg", 60, 40, "one camera", turn_deg=turn)

    assert unrotate_pixels(photo, np.array([[column + 0.5, row + 0.5]])).tolist() == [[47.5, 11.5]]
