"""Folders that cannot be reconstructed, or only in part: each ends with one sentence that says why, and exit code 4."""

import json
import shutil

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from benchmarks.synthetic.scenes import build_scene
from benchmarks.synthetic.walks import panorama
from sfm_app.cli.program import main
from sfm_app.synthetic import scenes
from sfm_app.synthetic.cameras import ArcOptions, arc, make_camera
from sfm_app.synthetic.compare import focal_error_percent
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder

CAMERA = make_camera(480, 360)
QUICK = "--quality", "draft", "--set", "report=false", "--set", "matching.max_image_size_px=360"
FAST = PhotoOptions(supersampling=1)


def run(folder, tmp_path, *flags):
    """`sfm-app run` up to the scene."""
    out = tmp_path / "out"
    return call("run", folder, "-o", out, "--until", "scene", *flags), out


def call(*arguments):
    return CliRunner().invoke(main, [*map(str, arguments), "-q", "--workers", "1", *QUICK])


def ends_with(result, *words):
    """Nothing was reconstructed, and one line says why, another what to do."""
    assert result.exit_code == 4, result.stderr
    error, hint = result.stderr.strip().splitlines()
    assert error.startswith("error: ") and hint.startswith("hint: ")
    assert [word for word in words if word not in error] == [] and result.stdout == ""


@pytest.fixture(scope="module")
def courtyard(tmp_path_factory):
    """Six photos of the courtyard."""
    folder = tmp_path_factory.mktemp("courtyard")
    write_photo_folder(folder, scenes.courtyard(), arc(CAMERA, ArcOptions(photos=6, sweep_deg=50.0)), FAST)
    return folder


@pytest.fixture(scope="module")
def heap(tmp_path_factory):
    """Four photos of another place."""
    folder = tmp_path_factory.mktemp("heap")
    write_photo_folder(folder, build_scene("heap"), arc(CAMERA, ArcOptions(photos=4, sweep_deg=36.0), 2), FAST)
    return folder


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "photos"
    place.mkdir()
    return place


def stamped(source, target):
    """A photo with the time and a logo on it."""
    photo = cv2.imread(str(source))
    cv2.putText(photo, "2024-05-13 14:02:37", (280, 345), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 160, 255), 1, cv2.LINE_AA)
    cv2.circle(photo, (60, 50), 32, (255, 255, 255), 3, cv2.LINE_AA)
    cv2.putText(photo, "FOTO", (33, 56), cv2.FONT_HERSHEY_DUPLEX, 0.6, (255, 255, 255), 1, cv2.LINE_AA)
    cv2.imwrite(str(target), photo, [cv2.IMWRITE_JPEG_QUALITY, 85])


def test_two_photos_of_different_places(courtyard, heap, folder, tmp_path):
    shutil.copy(courtyard / "view_02.jpg", folder / "a.jpg")
    shutil.copy(heap / "view_01.jpg", folder / "b.jpg")
    result, out = run(folder, tmp_path)
    ends_with(result, "the 2 photos show nothing in common")
    assert not (out / "sparse").exists()
    ends_with(call("calibrate", folder, "-o", out), "nothing in common")


def test_two_photos_of_different_places_with_one_logo(courtyard, heap, folder, tmp_path):
    stamped(courtyard / "view_02.jpg", folder / "a.jpg")
    stamped(heap / "view_01.jpg", folder / "b.jpg")
    ends_with(run(folder, tmp_path)[0], "nothing in common but a logo or time stamp")


@pytest.mark.parametrize(("noise", "says"), [(1.5, "no features"), (12.0, "features per photo")])
def test_photos_of_a_white_wall(folder, tmp_path, noise, says):
    y, x = np.mgrid[:360, :480]
    for k in range(5):
        lit = 225 + 8 * np.exp(-((x - 240 - 9 * k) ** 2 + (y - 150) ** 2) / 45000)
        gray = lit + np.random.default_rng(k).normal(scale=noise, size=lit.shape)
        Image.fromarray(np.clip(gray, 0, 255).astype(np.uint8)).convert("RGB").save(folder / f"{k}.jpg", quality=92)
    result, out = run(folder, tmp_path)
    ends_with(result, "hardly any texture", says)
    ends_with(call("calibrate", folder, "-o", out), "hardly any texture")


def test_a_panorama(folder, tmp_path):
    write_photo_folder(folder, scenes.courtyard(), panorama(CAMERA, 3, 20.0), FAST)
    result, out = run(folder, tmp_path)
    ends_with(result, "the camera only turned", "no depth")
    assert not (out / "sparse").exists()
    calibrated = call("calibrate", folder, "-o", out)
    assert calibrated.exit_code == 0  # a guess, and why
    said = " ".join(calibrated.stdout.split())  # it is wrapped
    assert "do not determine it" in said and "the camera only turned" in said


@pytest.mark.parametrize(("copies", "is_said"), [(1, False), (2, True)])
def test_many_copies_mean_that_the_camera_hardly_moves(copies, is_said, courtyard, folder, tmp_path):
    for path in courtyard.iterdir():
        shutil.copy(path, folder)
    for k in range(copies):
        shutil.copy(folder / f"view_{k:02d}.jpg", folder / f"copy_{k}.jpg")
    result = CliRunner().invoke(main, ["run", str(folder), "-o", str(tmp_path / "out"), "--until", "photos"])
    said = " ".join(result.stderr.split())
    assert (f"{copies} of {6 + copies} photos show the same as others" in said) == is_said, said


def test_twenty_copies_of_one_photo(courtyard, folder, tmp_path):
    """Half of them byte by byte, the others compressed more or less."""
    with Image.open(courtyard / "view_02.jpg") as photo:
        small = photo.crop((120, 90, 360, 270))
        for k in range(20):
            small.save(folder / f"{k:02d}.jpg", quality=90 if k < 10 else 65 + k)

    result, out = run(folder, tmp_path)
    assert result.exit_code == 3
    assert "only one usable photo" in result.stderr and "19 copies of another" in result.stderr

    result, out = run(folder, tmp_path, "--keep-low-quality")
    ends_with(result, "20 copies of one photo")
    ends_with(call("calibrate", folder, "-o", out, "--keep-low-quality"), "20 copies of one photo")


def test_two_groups_of_photos_give_the_larger_one(courtyard, heap, folder, tmp_path):
    for photo in sorted(courtyard.iterdir())[:5]:
        shutil.copy(photo, folder / f"court_{photo.name}")
    for photo in sorted(heap.iterdir())[:2]:
        shutil.copy(photo, folder / f"heap_{photo.name}")

    result, out = run(folder, tmp_path, "--json")

    assert result.exit_code == 0, result.stderr
    scene = json.loads(result.stdout)["scene"]
    assert (scene["registered"], scene["of"]) == (5, 7)
    assert sorted(scene["unregistered"]) == ["heap_view_00.jpg", "heap_view_01.jpg"]
    assert (out / "sparse").is_dir()
    told = call("run", folder, "-o", out, "--until", "scene", "-v").stdout
    assert "heap_view_00.jpg" in told and "heap_view_01.jpg" in told


def test_a_time_stamp_does_not_stop_the_camera(courtyard, folder, tmp_path):
    for photo in courtyard.iterdir():
        stamped(photo, folder / photo.name)
    result, out = run(folder, tmp_path, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["scene"]["registered"] == 6
    counts = json.loads((out / "manifest.json").read_text())["stages"]["view_graph"]["counts"]
    assert 0 < counts["stationary"] < 0.05 * counts["inliers"]


def test_two_photos_of_a_plane(folder, tmp_path):
    write_photo_folder(folder, build_scene("poster"), arc(CAMERA, ArcOptions(photos=2, sweep_deg=30.0)), FAST)
    result, out = run(folder, tmp_path)
    ends_with(result, "everything lies in one plane")
    assert not (out / "sparse").exists()


def test_a_plane_seen_from_many_sides_is_reconstructed(folder, tmp_path):
    views = arc(CAMERA, ArcOptions(photos=6, sweep_deg=70.0))
    truth = write_photo_folder(folder, build_scene("poster"), views, FAST)
    result, _ = run(folder, tmp_path, "--json")
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)
    [camera] = summary["calibration"].values()
    assert (camera["identifiable"], "everything lies in one plane" in camera["reason"]) == (False, True)
    assert summary["scene"]["registered"] == 6
    [refined] = summary["scene"]["cameras"].values()
    assert focal_error_percent(np.array(refined["K"]), truth) < 1.0
