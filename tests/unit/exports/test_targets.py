"""Targets of exports, refusals, interrupted exports, and model files from Python and the command line."""

import json

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

import sfm_app
from sfm_app import exports
from sfm_app.cli.program import main
from sfm_app.formats import EXPORTERS, SCENE_EXPORTERS
from sfm_app.formats.exporters import SceneExporter
from sfm_app.formats.scenes import plain_names
from sfm_app.frame.scale import MetricFrame
from sfm_app.pipeline import NAMES, SCALE, STAGES
from sfm_app.plugins import hookimpl, load_plugins
from sfm_app.runtime.workspace import StageRecord, Workspace


def call(*arguments):
    return CliRunner().invoke(main, ["export", *map(str, arguments)])


def test_help_and_unknown_formats_and_plugins_name_all_formats(make_run):
    shown = CliRunner().invoke(main, ["export", "--help"]).stdout
    refused = call(make_run().out, "--format", "3mf")
    listed = CliRunner().invoke(main, ["plugins"]).stdout
    assert refused.exit_code == 2 and "no file format is named '3mf'" in refused.stderr
    for name, part in {**EXPORTERS, **SCENE_EXPORTERS}.items():
        assert f"\n  {name} " in shown and part.summary[:20] in shown
        assert f"\n  {name} " in refused.stderr and part.summary in refused.stderr
        assert f"\n  {name} " in listed


def test_a_folder_tells_how_many_files_it_has(make_run):
    out = make_run("pinhole").out
    people, scripts = (call(out, "--format", "colmap", flag) for flag in ("-q", "--json"))
    assert people.stdout.startswith(f"{out / 'export' / 'colmap'}  9 files, "), people.stderr
    assert json.loads(scripts.stdout) == [str(out / "export" / "colmap")], scripts.stderr


@pytest.mark.parametrize("target", ["c.json", "cloud.laz", "new/CLOUD.LAZ"])
def test_the_suffix_says_which_format(make_run, tmp_path, target):
    result = call(make_run().out, "-o", tmp_path / target)
    assert result.exit_code == 0, result.stderr
    assert (tmp_path / target).stat().st_size > 100


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--format", "laz", "-o", "cloud.ply"), "cloud.ply does not end in .laz"),
        (("--format", "colmap", "--points"), "--points does not apply to the format 'colmap'"),
        (("--format", "draco", "-o", "model.ply"), "model.ply does not end in .glb"),
        (("-o", "model.3mf"), "no file format is named '3mf'"),
        ((), "no format is given"),
    ],
)
def test_contradictions_and_formats_that_are_not_there_end_with_exit_code_2(make_run, arguments, says):
    result = call(make_run().out, *arguments)
    assert (result.exit_code, says in result.stderr) == (2, True), result.stderr


@pytest.mark.parametrize("name", ["cloud-ply", "laz"])
def test_a_run_until_the_scene_has_no_dense_cloud(make_run, name):
    run = make_run(until="scene")
    result = call(run.out, "--format", name)
    assert (result.exit_code, "no dense cloud yet: stage `mesh` is missing" in result.stderr) == (3, True)
    assert not list(run.out.glob("cloud*"))


def test_an_export_replaces_an_earlier_one_and_nothing_else(make_run):
    run = make_run("pinhole")
    folder = sfm_app.export_scene(run.out, "colmap")
    sfm_app.export_scene(run.out, "nerfstudio", folder)
    assert (folder / "transforms.json").exists() and not (folder / "sparse").exists()
    (folder / "sparse_pc.splat").write_text("hours of training")
    with pytest.raises(sfm_app.InputError, match=r"holds files that no export has written, such as sparse_pc\.splat"):
        sfm_app.export_scene(run.out, "colmap", folder)
    assert (folder / "transforms.json").exists()
    assert sorted(path.name for path in folder.parent.iterdir()) == ["colmap"]


@pytest.mark.parametrize("kind", ["file", "link", "broken record"])
def test_what_no_export_has_written_is_refused(make_run, tmp_path, kind):
    run, target = make_run("pinhole"), tmp_path / "target"
    if kind == "file":
        target.write_text("mine")
    elif kind == "link":
        (tmp_path / "other").mkdir()
        target.symlink_to(tmp_path / "other")
    else:
        target.mkdir()
        (target / "export.json").write_text("[" * 100_000)
        (target / "mine.txt").write_text("mine")
    with pytest.raises(sfm_app.InputError) as caught:
        sfm_app.export_scene(run.out, "colmap", target)
    assert caught.value.hint == "name another place with -o"


def test_an_empty_folder_is_filled(make_run, tmp_path):
    (tmp_path / "target").mkdir()
    assert len(list(sfm_app.export_scene(make_run("pinhole").out, "splat", tmp_path / "target").iterdir())) == 3


@pytest.mark.parametrize("before", [False, True])
def test_an_interrupted_export_leaves_the_folder_as_it_was(make_run, monkeypatch, before):
    run = make_run("pinhole")
    if before:
        sfm_app.export_scene(run.out, "colmap")
    kept = {path: path.read_bytes() for path in (run.out / "export").rglob("*") if path.is_file()}
    written = []

    def fail(*given):
        written.append(given)
        if len(written) == 2:
            raise KeyboardInterrupt
        save(*given)

    save = exports.save_picture
    monkeypatch.setattr(exports, "save_picture", fail)
    with pytest.raises(KeyboardInterrupt):
        sfm_app.export_scene(run.out, "colmap")

    assert {path: path.read_bytes() for path in (run.out / "export").rglob("*") if path.is_file()} == kept
    assert len(list((run.out / "export").iterdir())) == before


def test_photos_that_are_gone_are_named(make_run):
    run = make_run("pinhole")
    (run.place.photos / "sub_a-b_c.png").unlink()
    result = call(run.out, "--format", "colmap")
    assert (result.exit_code, "the photo sub_a-b_c.png is gone" in result.stderr) == (3, True)
    assert "put them back" in result.stderr


def test_a_cloud_that_was_cut_off_or_removed_is_no_crash(make_run):
    run = make_run()
    file = run.place.surface / "fused.ply"
    file.write_bytes(file.read_bytes()[:200])
    cut = call(run.out, "--format", "laz")
    file.unlink()
    gone = call(run.out, "--format", "cloud-ply")
    assert (cut.exit_code, "are damaged" in cut.stderr) == (3, True), cut.stderr
    assert (gone.exit_code, "--from mesh" in gone.stderr) == (3, True), gone.stderr


@pytest.mark.parametrize("name", ["laz", "usdz", "usd", "draco"])
def test_a_missing_package_is_named_with_how_to_install_it(make_run, monkeypatch, name):
    monkeypatch.setattr("sfm_app.formats.exporters.find_spec", lambda _: None)
    result = call(make_run().out, "--format", name)
    assert (result.exit_code, "is not installed" in result.stderr) == (2, True)
    assert "hint: pip install 'sfm-app[export]'" in result.stderr


class Plugin:
    def __init__(self, name):
        self.name = name

    @hookimpl
    def sfm_scene_exporters(self):
        return [SceneExporter(self.name, lambda *_: None)]


def test_a_plug_in_may_bring_a_format_for_scenes_under_a_name_of_its_own():
    assert list(load_plugins([Plugin("centers")], installed=False).scene_exporters) == [*SCENE_EXPORTERS, "centers"]
    with pytest.raises(sfm_app.PluginError, match="two plug-ins offer 'ply'"):
        load_plugins([Plugin("ply")], installed=False)


def test_names_are_plain_and_all_different():
    names = ["a/b c", "a_b c", "A/B.C", "ä", "", "-x", "a/b c_2"]
    found = plain_names(names)
    assert found == ["a_b_c", "a_b_c_2", "A_B_C_3", "_", "__2", "-x", "a_b_c_2_2"]
    assert len({name.lower() for name in found}) == len(names)


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


@pytest.mark.parametrize("name", EXPORTERS)
def test_the_file_is_what_the_run_would_have_written(textured_ball, finished, name):
    paths = sfm_app.export_model(finished, name)
    stem = "model-draco" if name == "draco" else "model"
    assert paths[0] == finished / f"{stem}.{EXPORTERS[name].suffix}"
    assert {path.name: path.read_bytes() for path in paths} == EXPORTERS[name].write(textured_ball, stem)


@pytest.mark.parametrize(
    ("file_format", "target", "path"),
    [
        ("", "statue.obj", "statue.obj"), ("", "statue.GLB", "statue.GLB"), ("ply", "statue", "statue.ply"),
        ("ply", "statue v1.2", "statue v1.2.ply"), ("ply", "new/folder/statue.ply", "new/folder/statue.ply"),
        ("ply", ".", "model.ply"),
    ],
)  # fmt: skip
def test_the_target_is_named_as_people_name_files(finished, tmp_path, file_format, target, path):
    found = sfm_app.export_model(finished, file_format, tmp_path / target)
    assert found[0] == tmp_path / path
    assert len(trimesh.load(found[0], force="mesh").faces) == 320


@pytest.mark.parametrize("name", ["chair.mtl", "chair_0.jpg"])
def test_files_of_the_user_beside_the_model_are_kept(finished, tmp_path, name):
    (tmp_path / name).write_text("mine")
    result = call(finished, "-o", tmp_path / "chair.obj")
    assert (result.exit_code, f"{name} beside" in result.stderr) == (3, True)
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == [name]


@pytest.mark.parametrize("target", ["my chair.obj", "st\u00fchle v1.gltf"])
def test_a_model_is_exported_to_the_same_place_again(finished, tmp_path, target):
    first = sfm_app.export_model(finished, target=tmp_path / target)
    before = [path.read_bytes() for path in first]
    assert len(first) > 1 and sfm_app.export_model(finished, target=tmp_path / target) == first
    assert [path.read_bytes() for path in first] == before


def test_a_run_without_a_mesh_says_what_is_missing_and_what_to_do(tmp_path):
    place = Workspace(tmp_path / "out")
    place.manifest.finish("scene", StageRecord("", 0.0), {})
    result = call(place.root, "--format", "obj")
    assert result.exit_code == 3
    assert f"holds no model yet: stage `{LAST.name}` is missing" in result.stderr
    assert f"sfm-app run PHOTOS -o {place.root}" in result.stderr and "--points" in result.stderr


@pytest.mark.parametrize("place", [".", "nowhere"])
@pytest.mark.parametrize("name", ["colmap", "ply"])
def test_a_folder_that_is_no_run_is_refused_and_left_alone(tmp_path, name, place):
    result = call(tmp_path / place, "--format", name)
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
    surface = ball.surface
    np.savez(finished / LAST.files[0], vertices=surface.vertices, faces=surface.faces, colors=surface.colors)
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


def test_a_box_cuts_the_model_and_its_pages_without_changing_what_stays(textured_ball, finished, tmp_path):
    corners = textured_ball.surface.vertices[textured_ball.surface.faces]
    low, high = np.array([-9.0, 0.2, -9.0]), np.array([0.5, 9.0, 9.0])
    inside = ((corners >= low) & (corners <= high)).all(axis=(1, 2))
    result = call(finished, "-o", tmp_path / "part.obj", "--box", "0.5,0.2,9", "-9,9,-9")  # corners in any order
    part = trimesh.load(tmp_path / "part.obj", force="mesh", process=False)
    assert result.exit_code == 0 and 0 < inside.sum() < len(corners)
    places = lambda triangles: sorted(map(tuple, triangles.mean(axis=1).round(4)))  # noqa: E731
    assert places(part.triangles) == places(corners[inside])
    pages = set(textured_ball.texture.page[inside])
    assert len(list(tmp_path.glob("part*.jpg"))) == len(pages)


def test_only_the_pages_of_a_part_are_written(textured_ball):
    first = textured_ball.texture.page == textured_ball.texture.page.max()
    lone = textured_ball.surface.vertices[textured_ball.surface.faces[np.flatnonzero(first)[0]]]
    part = exports.crop(textured_ball, np.array([lone.min(axis=0), lone.max(axis=0)]))
    assert len(part.surface.faces) == 1 and np.allclose(part.surface.vertices[part.surface.faces[0]], lone)
    assert part.texture.page.tolist() == [0] and part.texture.pages[0] is textured_ball.texture.pages[-1]
    assert np.array_equal(part.texture.uv[0], textured_ball.texture.uv[first][0])


@pytest.mark.parametrize("name", ["cloud-ply", "laz"])
def test_a_box_cuts_the_dense_cloud(make_run, tmp_path, name):
    run = make_run()
    box = [(-1.0, -1.0, -1.0), (2.0, 2.0, 2.0)]
    points = np.stack([run.cloud[axis] for axis in "xyz"], axis=1)
    inside = ((points >= -1.0) & (points <= 2.0)).all(axis=1)
    file = sfm_app.export_scene(run.out, name, tmp_path / f"part.{SCENE_EXPORTERS[name].suffix}", box=box)
    if name == "laz":
        import laspy

        found = laspy.read(file).xyz
        assert len(found) == inside.sum() > 5
    else:
        found = trimesh.load(file).vertices
        assert np.allclose(np.sort(found, axis=0), np.sort(points[inside], axis=0), atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("--format", "obj", "--box", "5,5,5", "6,6,6"), 3, "nothing of the model is in the box"),
        (("--format", "obj", "--box", "5,5", "6,6,6"), 2, "'5,5' is no point"),
        (("--format", "colmap", "--box", "0,0,0", "1,1,1"), 2, "--box does not apply to the format 'colmap'"),
    ],
)
def test_boxes_that_are_of_no_use_are_refused(finished, arguments, code, says):
    result = call(finished, *arguments)
    assert (result.exit_code, says in result.stderr) == (code, True), result.stderr
    assert not list(finished.glob("model.*"))
