"""Rays against a mesh, and libraries that Open3D lacks."""

import importlib

import numpy as np
import pytest

from sfm_app.errors import SfmError
from sfm_app.meshing.ray_casting import Occluders, load_open3d


@pytest.mark.parametrize(
    ("message", "hint"),
    [
        ("libGL.so.1: cannot open shared object file: No such file or directory", "install libgl1"),
        ("libidn2.so.0: cannot open shared object file: No such file or directory", "install libidn2-0"),
        ("libnew.so.3: cannot open shared object file: No such file or directory", "libegl1 libgl1"),
    ],
)
def test_a_library_that_is_missing_is_named_with_its_package(monkeypatch, message, hint):
    real = importlib.import_module

    def fail(name, *arguments):
        if name == "open3d":
            raise ImportError(message)
        return real(name, *arguments)

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.raises(SfmError, match="cannot be loaded") as caught:
        load_open3d.__wrapped__()

    assert message in str(caught.value) and hint in caught.value.hint


WALL = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_what_stands_behind_a_wall_is_hidden():
    occluders = Occluders(WALL, FACES)
    points = np.array([[0.2, 0.1, -1.0], [0.2, 0.1, 1.0], [5.0, 0.1, -1.0], [0.2, 0.1, 0.0]])
    found = occluders.is_hidden(np.array([0.0, 0.0, 3.0]), 0.01, points)
    assert found.tolist() == [True, False, False, False]


def test_what_is_behind_the_camera_hides_nothing():
    assert not Occluders(WALL, FACES).is_hidden(np.array([0.0, 0.0, 1.0]), 0.01, np.array([[0.0, 0.1, 2.0]])).any()
    assert not Occluders(WALL, FACES).is_hidden(np.array([0.2, 0.1, -1.0]), 0.01, np.array([[0.2, 0.1, -2.0]])).any()


def test_a_point_within_the_slack_is_not_hidden_by_its_own_surface():
    occluders = Occluders(WALL, FACES)
    below, camera = np.array([[0.2, 0.1, -0.05]]), np.array([0.2, 0.1, 3.0])
    assert not occluders.is_hidden(camera, 0.1, below).any()
    assert occluders.is_hidden(camera, 0.01, below).all()
