"""Where exports go, what they refuse, and what an interrupted one leaves."""

import json

import pytest
from click.testing import CliRunner

import sfm_app
from sfm_app import exports
from sfm_app.cli import main
from sfm_app.formats import EXPORTERS, SCENE_EXPORTERS
from sfm_app.formats.exporters import SceneExporter
from sfm_app.formats.scenes import plain_names
from sfm_app.plugins import hookimpl, load_plugins


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
    run = make_run("pinhole")

    people, scripts = call(run.out, "--format", "colmap", "-q"), call(run.out, "--format", "colmap", "--json")

    assert people.exit_code == scripts.exit_code == 0, people.stderr + scripts.stderr
    assert people.stdout.startswith(f"{run.out / 'export' / 'colmap'}  9 files, ")
    assert json.loads(scripts.stdout) == [str(run.out / "export" / "colmap")]


@pytest.mark.parametrize(
    ("target", "written"),
    [("c.json", "c.json"), ("cloud.laz", "cloud.laz"), ("new/CLOUD.LAZ", "new/CLOUD.LAZ")],
)
def test_the_suffix_says_which_format(make_run, tmp_path, target, written):
    result = call(make_run().out, "-o", tmp_path / target)

    assert result.exit_code == 0, result.stderr
    assert (tmp_path / written).stat().st_size > 100


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--format", "laz", "-o", "cloud.ply"), "cloud.ply does not end in .laz"),
        (("--format", "colmap", "--points"), "--points does not apply to the format 'colmap'"),
        (("--format", "draco", "-o", "model.ply"), "model.ply does not end in .glb"),
    ],
)
def test_contradictions_end_with_exit_code_2(make_run, arguments, says):
    result = call(make_run().out, *arguments)

    assert (result.exit_code, says in result.stderr) == (2, True), result.stderr


@pytest.mark.parametrize("name", ["cloud-ply", "laz"])
def test_a_run_until_the_scene_has_no_dense_cloud(make_run, name):
    run = make_run(until="scene")

    result = call(run.out, "--format", name)

    assert (result.exit_code, "no dense cloud yet: stage `mesh` is missing" in result.stderr) == (3, True)
    assert not list(run.out.glob("cloud*"))


@pytest.mark.parametrize("name", SCENE_EXPORTERS)
def test_a_folder_without_a_run_is_left_alone(tmp_path, name):
    result = call(tmp_path, "--format", name)

    assert (result.exit_code, "holds no run" in result.stderr) == (3, True)
    assert list(tmp_path.iterdir()) == []


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


def test_a_plug_in_may_bring_a_format_for_scenes(make_run, tmp_path):
    class Plugin:
        @hookimpl
        def sfm_scene_exporters(self):
            return [SceneExporter("centers", lambda scene, target: target.write_text(str(len(scene.scene.registered))))]

    found = load_plugins([Plugin()], installed=False)

    assert list(found.scene_exporters) == [*SCENE_EXPORTERS, "centers"]


def test_a_name_belongs_to_one_format_only():
    class Plugin:
        @hookimpl
        def sfm_scene_exporters(self):
            return [SceneExporter("ply", lambda *_: None)]

    with pytest.raises(sfm_app.PluginError, match="two plug-ins offer 'ply'"):
        load_plugins([Plugin()], installed=False)


def test_names_are_plain_and_all_different():
    names = ["a/b c", "a_b c", "A/B.C", "ä", "", "-x", "a/b c_2"]

    found = plain_names(names)

    assert found == ["a_b_c", "a_b_c_2", "A_B_C_3", "_", "__2", "-x", "a_b_c_2_2"]
    assert len({name.lower() for name in found}) == len(names)
