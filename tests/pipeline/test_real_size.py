"""Real size by markers, distances and ground control points, from photos to exported files."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import laspy
import numpy as np
import pycolmap
import pytest
import trimesh
from scipy.spatial import KDTree

import sfm_app
from benchmarks.synthetic.scenes import marker_sheet
from sfm_app.frame.coordinates import LocalFrame, read_system
from sfm_app.frame.markers import draw_pattern
from sfm_app.geometry.poses import Similarity, umeyama
from sfm_app.settings import Settings
from sfm_app.stages import scene as scene_stage
from sfm_app.synthetic.cameras import ArcOptions, arc, make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder
from sfm_app.synthetic.scenes import courtyard
from sfm_app.types.scene import camera_center

pytestmark = pytest.mark.slow

SIDE_M = 0.4
UTM = np.array([500_000.0, 4_649_000.0, 320.0])
GROUND = np.array(
    [[-1.2, 0.0, 0.6], [1.1, 1.4, -0.3], [0.1, 1.36, 0.1], [-0.4, 2.4, -2.6], [0.9, 0.35, 1.2], [1.6, 2.0, -2.6]]
)
"""Places that are marked in photos; they need not be on a surface."""


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A run up to the size, of photos that show two markers."""
    place = tmp_path_factory.mktemp("size")
    scene = courtyard()
    markers = [
        *marker_sheet(draw_pattern("apriltag-36h11", 0), SIDE_M, (-0.85, 0.75, 0.75), 15, 75),
        *marker_sheet(draw_pattern("apriltag-36h11", 1), SIDE_M, (0.85, 0.72, 0.8), -20, 70),
    ]
    views = arc(make_camera(480, 320), ArcOptions(photos=7, sweep_deg=50.0))
    fine = PhotoOptions(supersampling=4)  # edges along the pixels lie between the rays
    truth = write_photo_folder(place / "photos", replace(scene, bodies=(*scene.bodies, *markers)), views, fine)
    run = sfm_app.reconstruct(place / "photos", place / "out", settings_with(markers=f"{SIDE_M}m"), last="scale")
    return SimpleNamespace(place=place, photos=place / "photos", out=place / "out", truth=truth, run=run)


def settings_with(**scale):
    return Settings.from_mapping({"quality": "draft", "report": False, "scale": scale})


def again(measured, last="scale", **scale):
    return sfm_app.reconstruct(measured.photos, measured.out, settings_with(**scale), last=last)


def read_scale(out):
    return json.loads((out / "scale.json").read_text())


def true_similarity(measured):
    """From OUT/sparse to the world."""
    scene = measured.run.scene
    names = sorted(scene.registered)
    found, true = (
        np.array([camera_center(poses[name]) for name in names])
        for poses in (scene.cam_from_world, measured.truth.cam_from_world)
    )
    return umeyama(found, true)


def to_utm(place):
    return LocalFrame(read_system("EPSG:32632"), UTM).positions(np.array([[place[0], -place[2], place[1]]]))[0]


def assert_scale(found, true, within):
    error = abs(np.log(found["scale"] / true))
    assert error < within and error < 3 * found["deviation"]
    assert found["deviation"] < 5 * within


def marks_file(measured, path, places, wrong=None):
    """Write ground control points as they are seen, with the errors of a hand that marks them."""
    rng, K, lines = np.random.default_rng(5), measured.truth.K, ["EPSG:32632"]
    for number, place in enumerate(places):
        east, north, up = to_utm(place) + (wrong or {}).get(number, np.zeros(3))
        for name, pose in sorted(measured.truth.cam_from_world.items()):
            seen = K @ (pose[:, :3] @ place + pose[:, 3])
            x, y = seen[:2] / seen[2] + 0.2 * rng.normal(size=2)
            if 0 < x < measured.truth.camera.width and 0 < y < measured.truth.camera.height:
                lines.append(f"{east:.4f} {north:.4f} {up:.4f} {x:.2f} {y:.2f} {name} p{number}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_two_markers_give_the_size(measured):
    found = read_scale(measured.out)
    assert found["unit"] == "meter" and len(found["evidence"]) == 2
    assert_scale(found, true_similarity(measured).scale, within=0.002)


def test_points_are_written_in_meters_and_the_model_on_disk_is_kept(measured):
    again(measured, markers=f"{SIDE_M}m")
    scale = read_scale(measured.out)["scale"]
    written = trimesh.load(measured.out / "points.ply").vertices
    own = np.array([point.xyz for point in pycolmap.Reconstruction(measured.out / "sparse").points3D.values()])
    at_a_point = KDTree(scale * own).query(written)[0] < 1e-5
    assert 0.7 < at_a_point.mean() < 1.0  # the others are corners of the drawn cameras
    (again_written,) = sfm_app.export_model(measured.out, target=measured.place / "again.ply", points=True)
    assert np.allclose(np.sort(trimesh.load(again_written).vertices, axis=0), np.sort(written, axis=0), atol=1e-5)


def test_a_distance_is_measured_in_meters(measured):
    again(measured, markers=f"{SIDE_M}m")
    to_world = true_similarity(measured)
    scale = read_scale(measured.out)["scale"]
    a, b = (scale * to_world.inverse()(np.array(place)) for place in ((-0.7, 0.9, 0.7), (0.8, 0.6, 0.9)))
    found = sfm_app.measure_distance(measured.out, a, b)
    assert found.metric and found.value == pytest.approx(np.linalg.norm([1.5, -0.3, 0.2]), rel=0.002)
    assert 0.0005 < found.deviation < 0.05


def test_a_finished_run_gives_arrays_in_meters(measured):
    again(measured, markers=f"{SIDE_M}m")
    run = sfm_app.read_run(measured.out)
    found = run.scene.arrays
    assert found.metric
    true = np.array([camera_center(measured.truth.cam_from_world[name]) for name in found.photos])
    assert umeyama(found.centers, true).scale == pytest.approx(1.0, abs=0.002)
    assert len(found.points) == run.scene.points and "meters" in run._repr_html_()


def test_only_what_depends_on_the_size_is_done_again(measured, monkeypatch):
    before = (measured.out / "manifest.json").read_text()
    monkeypatch.setattr(scene_stage, "make", None)  # nothing is mapped again
    again(measured, distances=[["0,0,0", "1,0,0", "2m"]])
    earlier, later = (json.loads(text)["stages"] for text in (before, (measured.out / "manifest.json").read_text()))
    assert {name for name in later if later[name] != earlier[name]} == {"scale"}
    assert read_scale(measured.out)["scale"] == pytest.approx(2.0)


def test_a_distance_that_contradicts_the_markers_is_named(measured):
    true = true_similarity(measured).scale
    again(measured, markers=f"{SIDE_M}m", distances=[["0,0,0", "0.4,0,0", f"{0.4 * true * 1.1}m"]])
    found = read_scale(measured.out)
    assert len(found["contradictions"]) == 1 and "the distance of" in found["contradictions"][0]
    assert "10 % larger" in found["contradictions"][0] or "9.9 % larger" in found["contradictions"][0]
    assert found["scale"] == pytest.approx(true, rel=0.002)


def test_control_points_give_size_and_place(measured, tmp_path):
    run = again(measured, control_points=str(marks_file(measured, tmp_path / "gcp_list.txt", GROUND[:5])))
    found = read_scale(measured.out)
    assert_scale(found, true_similarity(measured).scale, within=0.007)
    assert found["map"]["system"] == "EPSG:32632"
    frame = Similarity(found["scale"], np.array(found["R"]), np.array(found["t"]))
    for name, pose in run.scene.cam_from_world.items():
        east_north_up = (np.array(found["map"]["transform"]) @ [*frame(camera_center(pose)), 1.0])[:3]
        assert np.linalg.norm(east_north_up - to_utm(camera_center(measured.truth.cam_from_world[name]))) < 0.03


def test_a_wrong_control_point_is_named_and_left_out(measured, tmp_path):
    path = marks_file(measured, tmp_path / "gcp_list.txt", GROUND, wrong={1: (0.1, -0.05, 0.2)})
    run = again(measured, control_points=str(path))
    counts = run.manifest["stages"]["scale"]["counts"]
    assert set(counts["control_points"]["wrong"]) == {"p1"}
    assert counts["control_points"]["wrong"]["p1"] == pytest.approx(0.23, abs=0.03)
    assert any("'p1' contradicts the others" in text for text in counts["problems"])
    assert_scale(read_scale(measured.out), true_similarity(measured).scale, within=0.005)


def test_check_points_lie_inside_their_deviations(measured, tmp_path):
    path = marks_file(measured, tmp_path / "gcp_list.txt", GROUND)
    text = path.read_text(encoding="utf-8").replace(" p4\n", " CHK-4\n").replace(" p5\n", " chk-5\n")
    path.write_text(text, encoding="utf-8")
    run = again(measured, control_points=str(path))
    counts = run.manifest["stages"]["scale"]["counts"]
    assert counts["control_points"]["used"] == ["p0", "p1", "p2", "p3"]
    assert counts["check_points"]["inside"] == ["CHK-4", "chk-5"] and not counts["check_points"]["outside"]
    checks = [one for one in read_scale(measured.out)["surveyed"] if one["role"] == "check"]
    for one in checks:
        assert 0.0 < one["plan_m"] < 0.03 and one["plan_deviation_m"] < 0.1 and one["photos"] >= 2
    (moved := tmp_path / "moved.txt").write_text(  # a check point whose height is wrong
        "\n".join(_raise(line, 1.0) if line.endswith("CHK-4") else line for line in text.splitlines())
    )
    outside = again(measured, control_points=str(moved)).manifest["stages"]["scale"]["counts"]["check_points"]
    assert outside["outside"] == ["CHK-4"] and outside["height_rms_m"] == pytest.approx(np.sqrt(0.5), abs=0.05)


def _raise(line, by_m):
    x, y, z, *rest = line.split()
    return " ".join([x, y, f"{float(z) + by_m}", *rest])


def test_control_points_in_feet_give_the_same_size(measured, tmp_path):
    lines = marks_file(measured, tmp_path / "meters.txt", GROUND[:5]).read_text().splitlines()
    feet = LocalFrame(read_system("EPSG:2263"), np.array([980_000.0, 200_000.0, 100.0]))
    ground = LocalFrame(read_system("EPSG:32632"), UTM)
    rows = [line.split() for line in lines[1:]]
    positions = feet.positions(ground(np.array([row[:3] for row in rows], np.float64)))
    marks = [f"{x:.4f} {y:.4f} {z:.4f} {' '.join(row[3:])}" for (x, y, z), row in zip(positions, rows, strict=True)]
    path = tmp_path / "feet.txt"
    path.write_text("\n".join(["EPSG:2263", *marks]), encoding="utf-16")  # as PowerShell writes
    run = again(measured, control_points=str(path))
    assert_scale(read_scale(measured.out), true_similarity(measured).scale, within=0.007)
    assert read_scale(measured.out)["map"]["system"] == "EPSG:2263"
    assert run.manifest["stages"]["scale"]["counts"]["problems"] == []


def test_mistakes_in_the_control_file_are_named(measured, tmp_path):
    rows = [line.split() for line in marks_file(measured, tmp_path / "gcp.txt", GROUND).read_text().splitlines()]
    for name, change, says in (
        ("swapped.txt", lambda x, y, z, u, v: (y, x, z, u, v), "x and y are swapped"),
        ("shares.txt", lambda x, y, z, u, v: (x, y, z, float(u) / 480, float(v) / 320), "between 0 and 1"),
    ):
        lines = ["EPSG:32632", *(" ".join(map(str, [*change(*row[:5]), *row[5:]])) for row in rows[1:])]
        (tmp_path / name).write_text("\n".join(lines), encoding="utf-8")
        run = again(measured, control_points=str(tmp_path / name))
        (problem,) = run.manifest["stages"]["scale"]["counts"]["problems"]
        assert says in problem
        assert read_scale(measured.out)["unit"] == "arbitrary"


def test_markers_that_are_not_there_leave_the_unit_as_it_was(measured):
    run = again(measured, markers="50mm", marker_family="aruco-7x7")
    assert read_scale(measured.out)["unit"] == "arbitrary"
    assert run.manifest["stages"]["scale"]["counts"]["problems"] == [
        "no photo shows a marker; print a page of them with `sfm-app markers`"
    ]


def test_a_file_of_positions_puts_the_cloud_on_the_map(measured, tmp_path):
    """The scene counts as 20 times as large, so that GPS determines its size."""
    photos, out = shutil.copytree(measured.photos, tmp_path / "photos"), tmp_path / "out"
    true = {name: 20.0 * camera_center(pose) for name, pose in measured.truth.cam_from_world.items()}
    lines = [f"{name} {' '.join(f'{x:.3f}' for x in to_utm(place))}" for name, place in sorted(true.items())]
    (photos / "geo.txt").write_text("\n".join(["EPSG:32632", *lines, "gone.jpg 500000 4649000 320"]), encoding="utf-8")
    small = {"depth": {"max_image_size_px": 160}, "matching": {"max_image_size_px": 480}, "mesh": {"faces": 1000}}
    settings = Settings.from_mapping({"quality": "draft", "report": False, **small})
    run = sfm_app.reconstruct(photos, out, settings, last="mesh")
    assert "gone.jpg" in str(run.manifest["stages"]["photos"]["counts"]["missing"])
    assert run.manifest["stages"]["photos"]["counts"]["gps"] == len(true)
    assert not run.manifest["stages"]["photos"]["counts"]["unusable"]

    sfm_app.export_model(out, target=tmp_path / "files" / "points.glb", points=True)
    here = json.loads((tmp_path / "files" / "export.json").read_text())["map"]
    assert here["system"] == "EPSG:32632"
    cameras = run.scene.arrays
    centers = np.column_stack([cameras.centers, np.ones(len(cameras.photos))]) @ np.array(here["transform"]).T
    wanted = np.array([to_utm(true[name]) for name in cameras.photos])
    assert np.abs(centers[:, :3] - wanted).max() < 0.3

    cloud, plain = (sfm_app.export_scene(out, name, tmp_path / "files") for name in ("laz", "cloud-ply"))
    near = np.array(trimesh.load(plain).vertices, np.float64)
    mapped = np.column_stack([near, np.ones(len(near))]) @ np.array(here["transform"]).T
    read = laspy.read(cloud)
    assert np.abs(read.xyz - mapped[:, :3]).max() < 0.001 + 1e-6 * np.abs(near).max()
    assert read.header.parse_crs().to_epsg() == 32632
    assert np.ptp(read.z) < np.ptp(read.x)  # z is up
