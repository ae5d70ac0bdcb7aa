"""Fixtures that several groups of tests share."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import settings

from benchmarks.synthetic.walks import orbit
from sfm_app import operating_system
from sfm_app.operating_system import VARIABLE
from sfm_app.synthetic.cameras import ArcOptions, arc, make_camera
from sfm_app.synthetic.photo_folder import load_truth, save_truth, write_photo_folder
from sfm_app.synthetic.scenes import courtyard
from sfm_app.types import Model, PosedPhoto, Surface, Texture

# the time of an example depends on how busy the machine is
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

os.environ.setdefault("SFM_APP_WARM_UP_OF", str(os.getpid()))  # no process beside each run compiles all kernels

HANGS_S = 1200
"""A run that takes longer hangs: on a busy machine, where kernels are compiled first, one has taken 300 s."""

LONG = (
    "tests/real/", "tests/faults/", "tests/pipeline/", "tests/docs/", "tests/fuzz/", "tests/unit/test_examples.py",
    "tests/contract/",
)  # fmt: skip
"""What takes longest, in this order: a long file that begins last is waited for by all other workers."""
TOGETHER = ("tests/faults/", "tests/docs/", "tests/fuzz/")
"""Folders that one worker tries, since their files share a run of the whole program."""


def pytest_collection_modifyitems(config, items):
    """Let workers begin with what takes long."""
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: [not item.nodeid.startswith(place) for place in LONG])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give workers whole files, and some whole folders, in that order; xdist would begin with those of most tests."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return next((place for place in TOGETHER if nodeid.startswith(place)), super()._split_scope(nodeid))

    config.option.loadscopereorder = False
    return Scheduling(config, log)


@pytest.fixture(scope="session")
def rendered(tmp_path_factory):
    """Render a small photo folder, and return it with its truth."""
    place = tmp_path_factory.mktemp("rendered")
    views = arc(make_camera(480, 320), ArcOptions(photos=7, sweep_deg=50.0))
    save_truth(write_photo_folder(place / "photos", courtyard(), views), place)
    return place / "photos", load_truth(place)


@pytest.fixture(scope="session")
def ball() -> Model:
    """Make a unit ball whose vertex colors encode their positions."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.array(mesh.vertices, np.float64)
    colors = np.clip(128 + 120 * vertices, 0, 255).astype(np.uint8)
    return Model(Surface(vertices, np.array(mesh.faces, np.int64), colors))


@pytest.fixture(scope="session")
def textured_ball(ball) -> Model:
    """Texture the ball: its upper half from a red page, its lower half from a wide blue one."""
    corners = ball.surface.vertices[ball.surface.faces]
    page = (corners[:, :, 1].mean(axis=1) < 0).astype(np.int32)
    uv = (0.5 + 0.45 * corners[:, :, [0, 2]]).astype(np.float32)
    pages = np.full((64, 64, 3), (200, 40, 30), np.uint8), np.full((32, 96, 3), (30, 60, 200), np.uint8)
    return Model(ball.surface, Texture(uv, page, pages))


@pytest.fixture(scope="session")
def lit_ball(textured_ball) -> Model:
    """Give the textured ball a smooth normal map on each page, of half its size."""
    maps = []
    for page in textured_ball.texture.pages:
        y, x = np.mgrid[: page.shape[0] // 2, : page.shape[1] // 2] / 8.0
        normals = np.stack([0.3 * np.sin(x), 0.3 * np.cos(y), np.ones_like(x)], axis=2)
        maps.append(np.round(127.5 + 127.5 * normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(np.uint8))
    return replace(textured_ball, texture=replace(textured_ball.texture, normal_maps=tuple(maps)))


@pytest.fixture(scope="session")
def cloud(ball) -> Model:
    """Make a point cloud of the ball's vertices, with three cameras around it that look at the middle."""
    K = np.array([[800.0, 0, 310], [0, 820, 250], [0, 0, 1]])
    poses = orbit(make_camera(640, 480), 3, 120.0, 4.0, (0.0, 0.0, 0.0)).cam_from_world
    cameras = tuple(PosedPhoto(name, K, pose, 640, 480) for name, pose in poses.items())
    return Model(Surface(ball.surface.vertices, np.zeros((0, 3), np.int64), ball.surface.colors), cameras=cameras)


@pytest.fixture(scope="session")
def as_ordinary_user(tmp_path_factory):
    """Return a function that runs Python as a user bound by file modes, even where root runs the tests."""
    script = Path(__file__).with_name("ordinary.py")
    closed = tmp_path_factory.mktemp("closed") / "file"
    closed.touch(0)

    def run(*arguments):
        command = [sys.executable, str(script), *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=HANGS_S)

    if run("-c", f"open({str(closed)!r})").returncode == 0:
        pytest.skip("file modes restrict nobody here")
    return run


@pytest.fixture
def without(monkeypatch):
    """Return a function that takes abilities of the system away, here and in the processes that are started."""

    def take(*names):
        monkeypatch.setattr(
            operating_system, "HERE", operating_system.HERE - {operating_system.Ability(name) for name in names}
        )
        monkeypatch.setenv(VARIABLE, ",".join(names))

    return take
