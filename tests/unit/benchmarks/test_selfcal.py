import numpy as np
import pytest
from PIL import Image

from benchmarks.common import photo_sets
from benchmarks.selfcal import coverage as selfcal_coverage
from benchmarks.selfcal import score as selfcal_score
from benchmarks.selfcal.methods import MethodResult
from sfm_app.camera.models import camera_matrix
from sfm_app.settings import Settings
from sfm_app.types import Calibration

K = camera_matrix(1000.0, 1000.0, 400.0, 300.0)


def spotted(x, y, size=(800, 600)):
    """A black photo with a white block of 8 x 8 pixels whose top left corner is (x, y)."""
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    pixels[y : y + 8, x : x + 8] = 255
    return Image.fromarray(pixels)


@pytest.mark.parametrize(
    "change",
    [
        "", "crop:46,20", "scale:0.75,0.5", "window:200,150,512,400", "crop:46,20+scale:0.5,1", "pad:500,500",
        "corner:400,900", "fill:500,420", "crop:100,0+pad:300,600+scale:2,1",
    ],
)  # fmt: skip
def test_photo_and_camera_change_alike(change):
    todo = photo_sets.steps(change)
    spot = np.array([520.0, 312.0, 1.0])
    direction = np.linalg.solve(K, spot)
    changed = np.asarray(photo_sets.changed_photo(spotted(516, 308), todo).convert("L"), float)
    rows, columns = np.mgrid[: changed.shape[0], : changed.shape[1]] + 0.5
    center = (columns * changed).sum() / changed.sum(), (rows * changed).sum() / changed.sum()
    assert center == pytest.approx((photo_sets.changed_camera(K, todo, (800, 600)) @ direction)[:2], abs=0.05)


def test_who_took_photos_that_were_brought_to_one_size_is_not_told(tmp_path):
    (tmp_path / "set" / "images").mkdir(parents=True)
    spotted(0, 0, (80, 60)).save(tmp_path / "set" / "images" / "a.png")
    told = {
        change: photo_sets.photo_set(tmp_path, "set", change, tmp_path / "cache", "each").cameras_given
        for change in ("", "scale:0.5,0.5", "pad:90,90")
    }
    assert told == {"": True, "scale:0.5,0.5": True, "pad:90,90": False}


@pytest.mark.parametrize("text", ["crop:1", "crop:1,2,3", "zoom:2,2", "scale", "pad:1,2,3"])
def test_changes_that_nobody_knows_are_refused(text):
    with pytest.raises(ValueError):
        photo_sets.steps(text)


def test_copies_are_upright_and_tell_nothing(tmp_path):
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "Maker"
    spotted(0, 0, (80, 60)).save(tmp_path / "a.jpg", exif=exif)
    photo_sets.save_without_exif(tmp_path / "a.jpg", tmp_path / "out" / "a.png", ())
    with Image.open(tmp_path / "out" / "a.png") as copy:
        assert copy.size == (60, 80)
        assert not copy.getexif()
        assert "exif" not in copy.info


def found(K, **values):
    return Calibration(K, 800, 600, "zero-curves", **{"identifiable": True, **values})


def test_errors_are_counted_in_stated_deviations():
    camera = found(camera_matrix(1020.0, 1010.0, 400.0, 324.0), spread={"fx": 10.0, "fy": 10.0, "cx": 5.0, "cy": 6.0})
    answer = MethodResult("zero-curves", {"a": camera, "b": camera}, 0.1, 3)
    row = selfcal_score.row("set", answer, dict.fromkeys("ab", photo_sets.TrueCamera(K, -0.02)))
    assert (row["known"], row["in 3 sd"], row["worst e_focal %"]) == ("yes", "no", None)
    assert (row["fx sd"], row["fy sd"], row["cx sd"], row["cy sd"]) == (2.0, 1.0, 0.0, 4.0)
    assert (row["e_focal %"], row["center % of width"], row["k1 error"]) == (1.5, 3.0, 0.02)


def test_of_several_cameras_the_median_and_the_worst_count():
    focals = zip("abc", (500, 1000, 800), strict=True)
    truth = {name: photo_sets.TrueCamera(camera_matrix(f, f, 400.0, 300.0)) for name, f in focals}
    cameras = {name: found(camera_matrix(800.0, 800.0, 400.0, 300.0), identifiable=name == "a") for name in "abc"}
    row = selfcal_score.row("set", MethodResult("zero-curves", cameras, 0.1, 3), truth)
    assert (row["known"], row["e_focal %"], row["worst e_focal %"]) == ("1/3", 20.0, 60.0)


def test_trials_of_the_coverage_repeat_and_are_told_apart():
    trials = [selfcal_coverage.run_trial(seed, Settings()) for seed in (6, 6)]
    total = {row["method"]: row for row in selfcal_coverage.summary(trials)}
    assert trials[0].row == trials[1].row
    assert total["all"]["trials"] == 2
    assert sum(row["trials"] for name, row in total.items() if "cameras" in name) == 2
    assert 0 < total["all"]["median e_focal %"] < 5
