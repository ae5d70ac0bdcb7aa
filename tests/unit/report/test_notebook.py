"""What a notebook shows of a run."""

from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.report import notebook
from sfm_app.report.findings import Fact
from sfm_app.synthetic.cameras import arc, make_camera
from sfm_app.types import Model, PosedPhoto, Surface


@pytest.fixture
def shown(monkeypatch):
    """Makes the HTML of a run with these points, seen by photos of an arc."""

    def make(points, facts=()):
        views = arc(make_camera(64, 48))
        cameras = tuple(
            PosedPhoto(name, views.cameras[name].K, pose, 64, 48) for name, pose in views.cam_from_world.items()
        )
        surface = Surface(points, np.zeros((0, 3), np.int64), np.full((len(points), 3), 40, np.uint8))
        monkeypatch.setattr(notebook, "view_points", lambda _: Model(surface, cameras=cameras))
        monkeypatch.setattr(notebook, "glance", lambda _: list(facts))
        return SimpleNamespace(stages={})

    return make


def test_points_are_drawn_where_the_photo_in_the_middle_shows_them(shown):
    rng = np.random.default_rng(0)
    picture = notebook.model_cutout(shown(rng.uniform(-1, 1, (500, 3)) * [1, 0.5, 1] + [0, 1, 0]))
    assert picture.shape == (480, 640, 4)
    rows, columns = np.nonzero(picture[..., 3])
    assert 200 < len(rows) < 2100  # most of 500 squares of four pixels
    assert (picture[rows, columns] == [40, 40, 40, 255]).all()
    assert 100 < rows.mean() < 380 and 200 < columns.mean() < 440


def test_points_behind_the_camera_are_not_drawn(shown):
    assert not notebook.model_cutout(shown(np.array([[0.0, 1.0, 500.0]]))).any()


def test_text_in_the_table_is_escaped(shown):
    html = notebook.run_html(shown(np.zeros((1, 3)), [Fact("photos", "<img src=x onerror=alert(1)>", "& more")]))
    assert "<img src=x" not in html
    assert "&lt;img src=x onerror=alert(1)&gt; &amp; more" in html
    assert "data:image/png;base64," in html


def test_without_poses_there_is_a_table_only(monkeypatch):
    monkeypatch.setattr(notebook, "view_points", lambda _: None)
    monkeypatch.setattr(notebook, "glance", lambda _: [Fact("usable photos", "3")])
    html = notebook.run_html(SimpleNamespace(stages={}))
    assert "usable photos" in html and "base64" not in html
