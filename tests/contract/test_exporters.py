"""One set of tests for every registered file format, ours and any plug-in's."""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from sfm_app.errors import ReconstructionError
from sfm_app.plugins import load_plugins
from sfm_app.types import Model, Surface

EXPORTERS = load_plugins().exporters
READABLE = trimesh.available_formats()
KINDS = ("ball", "textured_ball", "cloud")


@pytest.fixture(params=EXPORTERS)
def name(request):
    return request.param


@pytest.fixture
def write(name):
    return EXPORTERS[name].write


@pytest.fixture(params=KINDS)
def model(request, name):
    made = request.getfixturevalue(request.param)
    if not (len(made.surface.faces) or EXPORTERS[name].holds_points):
        pytest.skip(f"{name} holds triangles only")
    return made


def as_model(name, places):
    """Places in the frame and the unit of the model."""
    return places[..., [0, 2, 1]] * (0.001, 0.001, -0.001) if name == "stl" else places


def test_the_first_file_is_the_one_to_open_and_all_lie_in_one_folder(name, write, model):
    files = write(model, "a model.v2")
    assert next(iter(files)) == f"a model.v2.{EXPORTERS[name].suffix}"
    assert all(isinstance(data, bytes) and data for data in files.values())
    assert all("/" not in file and "\\" not in file for file in files)


def test_files_beside_it_are_named_without_blanks_and_after_it(write, textured_ball):
    assert all(file.startswith("a_model") and " " not in file for file in list(write(textured_ball, "a model"))[1:])


def test_same_model_same_bytes_in_any_thread_and_the_model_is_left_alone(write, model):
    before = copy.deepcopy(model)
    with ThreadPoolExecutor(4) as pool:
        made = list(pool.map(lambda _: write(model, "model"), range(6)))
    assert all(files == made[0] for files in made) and made[0] == write(before, "model")


def test_the_shape_survives(name, write, model, tmp_path):
    if EXPORTERS[name].suffix not in READABLE:
        pytest.skip(f"trimesh does not read {name}")
    files = write(model, "model")
    for file, data in files.items():
        (tmp_path / file).write_bytes(data)

    parts = trimesh.load_scene(tmp_path / next(iter(files)), process=False).geometry.values()

    vertices = as_model(name, np.concatenate([np.asarray(part.vertices) for part in parts]))
    for corner in model.surface.vertices[::20]:
        assert np.linalg.norm(vertices - corner, axis=1).min() < 2e-6
    triangles = [part.triangles for part in parts if isinstance(part, trimesh.Trimesh)]
    assert sum(map(len, triangles)) == len(model.surface.faces)
    if triangles:
        a, b, c = np.moveaxis(as_model(name, np.concatenate(triangles)), 1, 0)
        volume = np.sum(np.cross(a, b) * c) / 6
        assert 4.0 < volume < 4.19  # of a ball, and positive only if the triangles face outward


@pytest.mark.parametrize(
    "vertices", [np.zeros((0, 3)), np.array([[np.nan, 0, 0], [1, 0, 0], [0, 1, 0]])], ids=["empty", "not finite"]
)
def test_what_no_file_can_hold_is_refused(write, vertices):
    colors = np.zeros((len(vertices), 3), np.uint8)
    with pytest.raises(ReconstructionError) as caught:
        write(Model(Surface(vertices, np.zeros((0, 3), np.int64), colors)), "model")
    assert caught.value.hint


def test_one_point_and_one_camera_are_enough(name, write, cloud):
    one = Surface(cloud.surface.vertices[:1], cloud.surface.faces, cloud.surface.colors[:1])
    if not EXPORTERS[name].holds_points:
        with pytest.raises(ReconstructionError, match="triangles only"):
            write(Model(one), "model")
        return
    assert write(Model(one), "model") and write(Model(one, cameras=cloud.cameras[:1]), "model")


def test_a_texture_without_triangles_is_no_texture(name, write, ball, textured_ball):
    if not EXPORTERS[name].holds_points:
        pytest.skip(f"{name} holds triangles only")
    points = replace(ball.surface, faces=np.zeros((0, 3), np.int64))
    none = replace(textured_ball.texture, uv=np.zeros((0, 3, 2), np.float32), page=np.zeros(0, np.int32))
    assert write(Model(points, none), "model") == write(Model(points), "model")
