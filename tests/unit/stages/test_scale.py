"""The stage that finds the frame of exported files, and writes the points in it."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sfm_app.colmap.backend import pycolmap
from sfm_app.errors import ConfigError
from sfm_app.plugins import load_plugins
from sfm_app.products import read_frame
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages import scale
from sfm_app.types import MapPlace, PhotoSet, Scene

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


def level_places(up, at=(0.3, 2.0, -1.0)):
    """Three places around `at` on a plane across `up`, counter-clockwise seen from there, as in the settings."""
    across = np.cross(up, [0.3, 0.5, 0.8])
    sides = (across, np.cross(up, across), -across)
    return tuple(",".join(f"{value:.9f}" for value in at + side) for side in sides)


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0, 90.0, 180.0])
def test_level_places_turn_the_model_upright_by_the_smallest_turn(run, tilt_deg):
    tilt = np.radians(tilt_deg)
    up = np.array([np.sin(tilt) * 0.6, np.cos(tilt), np.sin(tilt) * 0.8])
    before = written(run)[1]
    for places, normal in ((level_places(up), up), (level_places(up)[::-1], -up)):
        frame, points = written(run, level=[places], distances=[["0,0,0", "1,0,0", "3m"]])
        R = frame.from_model.R
        assert np.allclose(R @ normal, [0, 1, 0], atol=1e-7) and frame.from_model.scale == pytest.approx(3.0)
        assert np.trace(R) == pytest.approx(1 + 2 * normal[1], abs=1e-6)
        assert np.allclose(points[:200], frame.from_model(before[:200]), atol=1e-5)


def test_several_level_surfaces_are_averaged_and_a_map_keeps_its_up(run):
    level = [level_places(np.array([np.sin(angle), np.cos(angle), 0.0])) for angle in (0.1, 0.3)]
    frame, _ = written(run, level=level)
    assert np.allclose(frame.from_model.R @ [np.sin(0.2), np.cos(0.2), 0.0], [0, 1, 0], atol=1e-7)
    place = MapPlace("EPSG:4326", (8.0, 47.0, 400.0), 0.0)
    scene = Scene(run.workspace.sparse, {}, {}, {}, 200, 800, 0.3, gps_place=place)
    on_map = replace(run.with_fingerprint(""), settings=Settings.from_mapping({"scale": {"level": level}}))
    assert not scale.make(PHOTOS, scene, on_map).changes
    assert "not used" in on_map.statistics["problems"][0]


@pytest.mark.parametrize(
    "places", [("0,0,0", "1,0,0", "2,0,0.01"), ("0,0,0", "1,0,0", "1,0,0"), ("0,0,0", "1,0,0", "a")]
)
def test_level_places_on_a_line_are_refused(places):
    with pytest.raises(ConfigError, match=r"on a line|no point"):
        Settings.from_mapping({"scale": {"level": [places]}})
