"""The stage that finds the frame of exported files, and writes the points in it."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sfm_app.colmap.backend import pycolmap
from sfm_app.plugins import load_plugins
from sfm_app.products import read_frame
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages import scale
from sfm_app.types import PhotoSet, Scene

pytestmark = pytest.mark.slow
PHOTOS = PhotoSet(Path("photos"), ())
FILES = ("points.ply", "points.glb")


@pytest.fixture
def run(tmp_path):
    """A run whose scene is there."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 4, 200
    place = Workspace(tmp_path)
    place.sparse.mkdir()
    pycolmap.synthesize_dataset(options).write(place.sparse)
    return RunContext(Settings(), place, load_plugins(), ThreadPoolExecutor(1), 1)


def written(run, **settings):
    """Frame, and vertices of the points, of a run with these settings of the size."""
    scene = Scene(run.workspace.sparse, {}, {}, {}, 200, 800, 0.3)
    run = replace(run.with_fingerprint(""), settings=Settings.from_mapping({"scale": settings}))
    frame = scale.make(PHOTOS, scene, run)
    sizes = {name: (run.workspace.root / name).stat().st_size for name in FILES}
    assert run.statistics["bytes"] == sizes and min(sizes.values()) > 1000
    return frame, np.asarray(trimesh.load(run.workspace.root / FILES[0], process=False).vertices)


def test_points_are_written_in_the_frame_of_exports_whatever_was_known_before(run):
    frame, points = written(run)
    first = [(run.workspace.root / name).read_bytes() for name in FILES]
    assert not frame.is_metric and len(points) > 200
    longer, moved = written(run, distances=[["0,0,0", "1,0,0", "3m"]])
    assert longer.from_model.scale == pytest.approx(3.0) and np.allclose(moved[:200], 3.0 * points[:200], atol=1e-5)
    assert read_frame(run.workspace).from_model.scale == longer.from_model.scale
    written(run)
    assert [(run.workspace.root / name).read_bytes() for name in FILES] == first
