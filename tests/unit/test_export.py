"""A finished run in another format, from Python and from the command line."""

import json

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

import sfm_app
from sfm_app.cli import main
from sfm_app.formats import EXPORTERS
from sfm_app.frame.scale import MetricFrame
from sfm_app.pipeline import NAMES, SCALE, STAGES
from sfm_app.runtime.workspace import StageRecord, Workspace

LAST = STAGES[-1].takes[-1]
"""The stage whose product the files of the model hold."""


@pytest.fixture
def finished(textured_ball, tmp_path):
    """What a run leaves that has only its files to write."""
    place = Workspace(tmp_path / "out")
    place.texture.mkdir(parents=True)
    surface, texture = textured_ball.surface, textured_ball.texture
    np.savez(
        place.root / LAST.files[0],
        vertices=surface.vertices, faces=surface.faces, colors=surface.colors,
        uv=texture.uv, page=texture.page, page0=texture.pages[0], page1=texture.pages[1],
    )  # fmt: skip
    place.scale.write_text(json.dumps(MetricFrame().to_dict()))
    for stage in NAMES[:-1]:
        digest = (SCALE if stage == SCALE.name else LAST).digest(place)
        place.manifest.finish(stage, StageRecord("", 0.0, digest=digest), {})
    return place.root


def call(*arguments):
    return CliRunner().invoke(main, ["export", *map(str, arguments)])


@pytest.mark.parametrize("name", EXPORTERS)
def test_the_file_is_what_the_run_would_have_written(textured_ball, finished, name):
    paths = sfm_app.export_model(finished, name)

    stem = "model-draco" if name == "draco" else "model"
    assert paths[0] == finished / f"{stem}.{EXPORTERS[name].ending}"
    assert {path.name: path.read_bytes() for path in paths} == EXPORTERS[name].write(textured_ball, stem)


@pytest.mark.parametrize(
    ("file_format", "target", "path"),
    [
        ("", "statue.obj", "statue.obj"),
        ("", "statue.GLB", "statue.GLB"),
        ("ply", "statue", "statue.ply"),
        ("ply", "statue v1.2", "statue v1.2.ply"),
        ("ply", "new/folder/statue.ply", "new/folder/statue.ply"),
        ("ply", ".", "model.ply"),
    ],
)
def test_the_target_is_named_as_people_name_files(finished, tmp_path, file_format, target, path):
    found = sfm_app.export_model(finished, file_format, tmp_path / target)

    assert found[0] == tmp_path / path
    assert len(trimesh.load(found[0], force="mesh").faces) == 320


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("--format", "3mf"), 2, "no file format is named '3mf'"),
        (("-o", "model.3mf"), 2, "no file format is named '3mf'"),
        (("-o", "model.ply", "--format", "glb"), 2, "model.ply does not end in .glb"),
        ((), 2, "no format is given"),
    ],
)
def test_formats_that_are_not_there_end_with_exit_code_2(finished, arguments, code, says):
    result = call(finished, *arguments)

    assert (result.exit_code, says in result.stderr) == (code, True), result.stderr
    assert "obj" in result.stderr or "glb" in result.stderr


def test_a_run_without_a_mesh_says_what_is_missing_and_what_to_do(tmp_path):
    place = Workspace(tmp_path / "out")
    place.manifest.finish("scene", StageRecord("", 0.0), {})

    result = call(place.root, "--format", "obj")

    assert result.exit_code == 3
    assert f"holds no model yet: stage `{LAST.name}` is missing" in result.stderr
    assert f"sfm-app run PHOTOS -o {place.root}" in result.stderr and "--points" in result.stderr


def test_a_run_without_a_scene_has_no_points_either(tmp_path):
    place = Workspace(tmp_path / "out")
    place.manifest.finish("photos", StageRecord("", 0.0), {})

    result = call(place.root, "--format", "ply", "--points")

    assert result.exit_code == 3
    assert "no points yet: stage `scene` is missing" in result.stderr and "--points" not in result.stderr


@pytest.mark.parametrize("place", [".", "nowhere"])
def test_a_folder_that_is_no_run_is_refused(tmp_path, place):
    result = call(tmp_path / place, "--format", "ply")

    assert (result.exit_code, "holds no run" in result.stderr) == (3, True)
    assert list(tmp_path.iterdir()) == []


def test_a_surface_that_has_gone_is_missed_by_name(finished):
    (finished / LAST.files[0]).unlink()

    result = call(finished, "--format", "ply")

    assert (result.exit_code, LAST.files[0] in result.stderr) == (3, True)


@pytest.mark.parametrize("left", [0, 100, -1])
def test_a_surface_that_was_cut_off_is_no_crash(finished, left):
    stored = finished / LAST.files[0]
    stored.write_bytes(stored.read_bytes()[:left])

    result = call(finished, "--format", "ply")

    assert (result.exit_code, "are damaged" in result.stderr) == (3, True)
    assert "resumes where it stopped" in result.stderr


def test_a_model_without_a_texture_has_the_colors_of_its_vertices(ball, finished):
    np.savez(
        finished / LAST.files[0], vertices=ball.surface.vertices, faces=ball.surface.faces, colors=ball.surface.colors
    )
    place = Workspace(finished)
    place.manifest.finish(LAST.name, StageRecord("", 0.0, digest=LAST.digest(place)), {})

    (path,) = sfm_app.export_model(finished, "glb")

    assert path.read_bytes() == EXPORTERS["glb"].write(ball, "model")["model.glb"]


def test_sizes_are_told_to_people_and_paths_to_scripts(finished):
    people, scripts = call(finished, "--format", "obj"), call(finished, "--format", "obj", "--json")

    size_kb = (finished / "model.obj").stat().st_size / 1e3
    assert people.stdout.splitlines()[0] == f"{finished / 'model.obj'}  {size_kb:.0f} kB"
    assert json.loads(scripts.stdout)[0] == str(finished / "model.obj")


def test_a_target_that_cannot_be_written_is_named(finished, tmp_path):
    (tmp_path / "file").write_text("in the way")

    result = call(finished, "-o", tmp_path / "file" / "model.glb")

    assert (result.exit_code, "cannot write" in result.stderr) == (3, True)
    assert str(tmp_path / "file") in result.stderr
