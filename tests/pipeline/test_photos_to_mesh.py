"""Rendered photos end to end: the command a user types, on a scene whose camera and surface are known."""

import itertools
import json
import os
import shutil
import subprocess
import sys
import time

import laspy
import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

import sfm_app
from benchmarks.surface.left_out import remake_without
from benchmarks.surface.photos import placed_photos
from sfm_app.cli.program import main
from sfm_app.colmap.dense import DenseStore
from sfm_app.formats import EXPORTERS, SCENE_EXPORTERS
from sfm_app.pipeline import NAMES
from sfm_app.products import read_texture
from sfm_app.runtime.workspace import LOCK, Workspace
from sfm_app.settings import Settings, merge_nested
from sfm_app.stages import texture
from sfm_app.stages.texture import PARTS, FileStore, photo_views
from sfm_app.synthetic.compare import center_error_percent, focal_error_percent, surface_errors
from sfm_app.texture import pages
from sfm_app.types.scene import camera_center

QUICK = {"quality": "draft", "report": False, "depth": {"max_image_size_px": 360}}
DRAFT = Settings.from_mapping(QUICK)
SMALL = {"max_image_size_px": 360}
SMALLER = "--set", "matching.max_image_size_px=360"


@pytest.fixture(scope="module")
def finished(rendered, tmp_path_factory):
    photos, truth = rendered
    out = tmp_path_factory.mktemp("finished") / "out"
    return sfm_app.reconstruct(photos, out, DRAFT), truth


def test_camera_is_found(finished):
    run, truth = finished
    refined = next(iter(run.scene.cameras.values())).K
    assert run.calibration.identifiable and focal_error_percent(run.calibration.K, truth) < 2.0
    assert center_error_percent(run.calibration.K, truth) < 4.0 and focal_error_percent(refined, truth) < 1.0


def test_every_photo_has_a_place(finished):
    run, truth = finished
    assert set(run.scene.registered) == set(truth.cam_from_world)
    assert 0.05 < run.scene.mean_reprojection_px < 1.0
    assert repr(run) == f"Run({str(run.out)!r}: 7 photos placed, model.glb)"


def test_mesh_lies_on_the_true_surface(finished):
    run, truth = finished
    mesh = trimesh.load(run.out / "model.ply", process=False)
    centers = {name: camera_center(pose) for name, pose in run.scene.cam_from_world.items()}
    to_truth, _ = surface_errors(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64), centers, truth)
    assert len(mesh.faces) > 5000 and np.median(to_truth) < 0.01


def test_a_normal_map_is_made_from_the_mesh_on_and_leaves_nothing_behind(finished, rendered, tmp_path):
    out, place = tmp_path / "out", Workspace(tmp_path / "out")
    shutil.copytree(finished[0].out, out, symlinks=True)
    plain, before = (out / "model.glb").read_bytes(), place.manifest.read()["stages"]
    lit = Settings.from_mapping(merge_nested(DRAFT.model_dump(), {"texture": {"normal_map": True}}))

    run = sfm_app.reconstruct(rendered[0], out, lit)
    mapped, after = run.mesh_path.read_bytes(), place.manifest.read()["stages"]

    assert {name for name in NAMES if after[name] != before[name]} == {"mesh", "texture", "files"}
    assert b'"TANGENT"' in mapped and b'"normalTexture"' in mapped and b"KHR_materials_unlit" not in mapped
    assert after["texture"]["counts"]["normal_map_share"] > 0.9
    (relief,) = read_texture(place).texture.normal_maps
    assert np.abs(relief.reshape(-1, 3).mean(axis=0) - [128, 128, 255]).max() < 12
    assert (relief != [128, 128, 255]).any(axis=2).mean() > 0.3
    assert sfm_app.reconstruct(rendered[0], out, DRAFT).mesh_path.read_bytes() == plain
    assert not place.fine_surface.exists()


def test_what_a_photo_shows_is_not_in_the_texture_that_is_made_without_it(finished, tmp_path, monkeypatch):
    run, _ = finished
    whole = read_texture(Workspace(run.out))
    name, used = run.scene.registered[3], []
    monkeypatch.setattr(texture, "photo_views", lambda scene, ask=photo_views: used.extend(ask(scene)) or ask(scene))

    without = remake_without(run.out, tmp_path / "copy", name, DRAFT.model_dump())

    assert {view.name for view in used} == set(run.scene.registered) - {name}
    kept = np.load(run.out / "surface" / "surface.npz")["vertices"]  # of which texturing cuts borders
    assert set(map(tuple, without.surface.vertices)) <= set(map(tuple, kept))
    assert 0.9 * len(kept) < len(without.surface.vertices) < 1.01 * len(kept), (len(kept), len(whole.surface.vertices))
    assert without.texture.pages[0].shape[1] > 256 and np.isfinite(without.texture.uv).all()
    before, after = (part.texture.pages[0] for part in (whole, without))
    assert before.shape != after.shape or (before != after).mean() > 0.02
    assert set(run.scene.registered) == set(placed_photos(run.out))


def test_glb_loads_upright_and_textured(finished):
    run, _ = finished
    (mesh,) = trimesh.load(run.mesh_path, process=False).geometry.values()
    page = np.asarray(mesh.visual.material.baseColorTexture)
    assert run.mesh_path.name == "model.glb" and len(mesh.visual.uv) == len(mesh.vertices)
    assert mesh.visual.uv.min() >= 0 and mesh.visual.uv.max() <= 1 and page.std(axis=(0, 1)).min() > 10
    up = np.mean([-pose[1, :3] for pose in run.scene.cam_from_world.values()], axis=0)
    assert up[1] / np.linalg.norm(up) > 0.99


def test_manifest_accounts_for_every_stage(finished):
    run, _ = finished
    assert tuple(run.manifest["stages"]) == NAMES
    assert run.manifest["stages"]["scene"]["counts"]["registered"] == len(run.scene.registered)
    assert run.manifest["settings"]["quality"] == "draft"
    for stage in run.manifest["stages"].values():
        assert 100 < stage["peak_mb"] < 4000
        assert 0 <= stage["cpu_seconds"] < 1.2 * (os.cpu_count() or 1) * stage["seconds"] + 1.0


def test_the_texture_covers_the_mesh(finished):
    run, _ = finished
    counts = run.manifest["stages"]["texture"]["counts"]
    assert counts["unseen_triangles"] < 0.25 * run.manifest["stages"]["mesh"]["counts"]["triangles"]
    assert len(counts["pages"]) == 1 and counts["rejected"] == {}
    np.testing.assert_allclose(list(counts["gains"].values()), 1.0, atol=0.05)  # rendered with one exposure


@pytest.mark.parametrize("name", [*EXPORTERS, *SCENE_EXPORTERS])
def test_every_format_is_written(finished, tmp_path, name):
    run, _ = finished

    if name in EXPORTERS:
        files = sfm_app.export_model(run.out, name, tmp_path / "made")
        assert 20_000 < sum(path.stat().st_size for path in files) < 20_000_000
        return
    place = sfm_app.export_scene(run.out, name, tmp_path / "made")
    if name in ("cloud-ply", "las", "laz"):
        counts = run.manifest["stages"]["mesh"]["counts"]
        cloud = trimesh.load(place).vertices if name == "cloud-ply" else laspy.read(place).xyz
        assert len(cloud) == counts["fused_points"]
    else:
        assert place.exists()


def test_a_second_run_does_nothing(finished, rendered):
    run, _ = finished
    kept = [path for path in run.out.rglob("*") if path.is_file() and path.name not in ("log.txt", LOCK)]
    stamps = {path: path.stat().st_mtime_ns for path in kept}
    again = sfm_app.reconstruct(rendered[0], run.out, DRAFT)
    assert again.manifest == run.manifest and {path: path.stat().st_mtime_ns for path in stamps} == stamps


def test_a_run_that_stops_early_says_nothing_of_an_older_mesh(finished, rendered):
    whole, _ = finished
    run = sfm_app.reconstruct(rendered[0], whole.out, DRAFT, last="scene")
    assert run.mesh_path is None and run.scene.points == whole.scene.points
    assert tuple(run.manifest["stages"]) == NAMES[: NAMES.index("scene") + 1]
    assert tuple(Workspace(whole.out).manifest.read()["stages"]) == NAMES


class Killed(BaseException):
    """What no program catches."""


def killed_at(number, monkeypatch, store, method, *arguments, **options):
    """A run that ends when it is about to keep its `number`-th thing by this method of a store."""
    keep, calls = getattr(store, method), itertools.count(1)

    def fail(*what):
        if next(calls) >= number:
            raise Killed
        keep(*what)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(store, method, fail)
        sfm_app.reconstruct(*arguments, **options)


def stamps(folder, pattern):
    return {path: path.stat().st_mtime_ns for path in folder.glob(pattern)}


def test_a_run_killed_among_its_depth_maps_ends_with_the_same_bytes(finished, rendered, tmp_path, monkeypatch):
    whole, out = finished[0].out, tmp_path / "out"
    maps = out / "dense/stereo/depth_maps"
    shutil.copytree(whole, out, symlinks=True)
    expected = (whole / "model.glb").read_bytes()

    killed_at(4, monkeypatch, DenseStore, "write_estimate", rendered[0], out, DRAFT, first="depth_maps")
    matched = stamps(maps, "*.photometric.bin")
    assert len(matched) == 3
    killed_at(3, monkeypatch, DenseStore, "write_maps", rendered[0], out, DRAFT)
    assert stamps(maps, "*.photometric.bin").items() > matched.items()
    confirmed = stamps(maps, "*.geometric.bin")
    assert len(confirmed) == 2
    killed_at(3, monkeypatch, DenseStore, "write_depth", rendered[0], out, DRAFT)
    assert stamps(maps, "*.geometric.bin").items() > confirmed.items()
    assert len(stamps(maps, "*.closed.bin")) == 2
    killed_at(3, monkeypatch, DenseStore, "write_maps", rendered[0], out, DRAFT)  # two photos are filled
    assert "depth_maps" not in Workspace(out).manifest.read()["stages"]
    run = sfm_app.reconstruct(rendered[0], out, DRAFT)

    assert not stamps(maps, "*.closed.bin")
    assert run.mesh_path.read_bytes() == expected


def test_a_run_killed_in_its_texture_ends_with_the_same_bytes(finished, rendered, tmp_path, monkeypatch):
    whole, out = finished[0], tmp_path / "out"
    parts = out / "texture" / PARTS
    shutil.copytree(whole.out, out, symlinks=True)
    monkeypatch.setattr(pages, "CHECKPOINTS", pages.CheckpointOptions(every_s=-1.0, most_time=np.inf))

    killed_at(4, monkeypatch, FileStore, "keep", rendered[0], out, DRAFT, first="texture")
    looks = stamps(parts, "view*.npz")
    assert len(looks) == 3
    killed_at(len(whole.scene.registered), monkeypatch, FileStore, "keep", rendered[0], out, DRAFT)
    assert stamps(parts, "view*.npz").items() > looks.items() and (parts / f"{pages.CHECKPOINT_NAME}.npz").exists()
    run = sfm_app.reconstruct(rendered[0], out, DRAFT)

    assert run.mesh_path.read_bytes() == whole.mesh_path.read_bytes() and not parts.exists()


def test_one_worker_and_two_give_the_same_bytes(rendered, tmp_path):
    outs = []
    for workers in (1, 2):
        out = tmp_path / str(workers)
        settings = Settings.from_mapping(
            {"quality": "draft", "report": False, "workers": workers, "seed": 5, "matching": SMALL}
        )
        sfm_app.reconstruct(rendered[0], out, settings, last="scene")
        outs.append(out)
    sparse = [f"sparse/{part}.bin" for part in ("cameras", "images", "points3D")]
    for name in ("view_graph.npz", "calibration.json", "scene.json", *sparse):
        assert (outs[0] / name).read_bytes() == (outs[1] / name).read_bytes()


def test_calibrate_prints_json(rendered):
    photos, truth = rendered
    result = CliRunner().invoke(main, ["calibrate", str(photos), "--json", "-q", "--quality", "draft", *SMALLER])
    assert result.exit_code == 0, result.stderr
    (camera,) = json.loads(result.stdout).values()
    assert camera["identifiable"] is True and focal_error_percent(np.array(camera["K"]), truth) < 2.0


def test_the_literal_methods_give_points_that_open(rendered, tmp_path):
    """`--until scale` with the methods as they stand in print."""
    out = tmp_path / "out"
    literal = [
        "--estimator",
        "lev-ransac-thesis",
        "--calibrator",
        "zero-curves-thesis",
        "--set",
        "report=false",
        *SMALLER,
    ]
    flags = ["-o", str(out), "--quality", "draft", *literal, "--until", "scale", "--json", "-q"]

    result = CliRunner().invoke(main, ["run", str(rendered[0]), *flags])

    assert result.exit_code == 0, result.stderr
    scene = json.loads(result.stdout)["scene"]
    assert scene["registered"] >= 5 and not (out / "dense").exists()
    assert scene["files"] == [str(out / f"points.{suffix}") for suffix in ("glb", "ply")]
    web = trimesh.load(out / "points.glb", process=False).geometry
    count = len(web["points"].vertices)
    assert 0.9 * scene["points"] < count <= scene["points"]  # without those far out
    assert len(web["cameras"].entities) > 0
    cloud = trimesh.load(out / "points.ply", process=False)
    np.testing.assert_allclose(cloud.vertices[:count], web["points"].vertices, atol=1e-5)
    assert len(cloud.vertices) > count  # the cameras, dotted
    assert np.std(cloud.colors[:count, :3], axis=0).min() > 10


@pytest.mark.skipif(sys.platform == "win32", reason="signals are another thing there")
def test_a_terminated_run_says_so_and_goes_on(rendered, tmp_path):
    command = [sys.executable, "-m", "sfm_app", "run", str(rendered[0]), "-o", str(tmp_path / "out"), "-q"]
    command += ["--quality", "draft", "--set", "report=false", *SMALLER]
    # a run to the end: what is asked of it must not be done before the signal comes, however busy the machine is
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        while not (tmp_path / "out" / "database.db").exists() and process.poll() is None:
            time.sleep(0.05)
        process.terminate()
        _, said = process.communicate(timeout=60)

    assert (process.returncode, said.splitlines()[:1]) == (130, ["error: interrupted"])
    assert "Traceback" not in said
    assert subprocess.run([*command, "--until", "intrinsics"], capture_output=True, check=False).returncode == 0
    assert (tmp_path / "out" / "calibration.json").exists()
