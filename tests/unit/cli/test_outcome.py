"""The few lines at the end of a run."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.api import Run
from sfm_app.cli.outcome import outcome_lines
from sfm_app.geometry.camera import camera_matrix
from sfm_app.types import Calibration, CameraModel, Intrinsics, Scene

K = camera_matrix(500.0, 510.0, 480.0, 410.0)
KNOWN = Calibration(K, 1000, 800, "zero-curves", True, spread={"fx": 1.25})
AFTER = CameraModel("OPENCV", (501.0, 510.0, 480.0, 410.0, 0, 0, 0, 0), K, 1000, 800, {"fx": 0.754})
SIZE = {
    "unit": "meter",
    "deviation_percent": 0.12,
    "source": "marker a 1, marker a 2",
    "contradictions": ["marker a 3 contradicts the 2 others"],
    "problems": [],
}


@pytest.fixture
def finished(tmp_path):
    """A run with a model of two photos of four."""
    for name in ("report.html", "model.glb", "model.ply"):
        (tmp_path / name).write_bytes(bytes(2000))
    counts = {
        "photos": {"usable": 4, "unusable": {"notes.txt": "not a photo"}},
        "scale": SIZE,
        "mesh": {"triangles": 12_345},
        "files": {"bytes": {"model.ply": 2000, "model.glb": 2000}},
    }
    stages = {name: {"counts": part, "seconds": 60.0} for name, part in counts.items()}
    poses = {name: np.eye(3, 4) for name in ("a.jpg", "b.jpg")}
    lost = {"c.jpg": "too few matches", "d.jpg": "too few matches"}
    scene = Scene(tmp_path, poses, lost, {"one": AFTER}, 10, 20, 0.312)
    known = Intrinsics({"one": KNOWN})
    return Run(tmp_path, known, scene, None, tmp_path / "model.glb", {"stages": stages}, tmp_path / "report.html")


def test_it_says_what_came_of_it_how_good_it_is_and_where(finished):
    lines = outcome_lines(finished, 250.0)

    assert lines[0] == "A model of 2 of 4 photos, with 12,345 triangles."
    assert "photos show its points to 0.31 px" in lines[1]
    assert lines[2].startswith("camera      focal 501.0 +- 0.75 px, sees 90 degrees")
    assert lines[3] == "size        in meters, +- 0.12 %, by marker a 1, marker a 2"
    assert lines[4] == "missing     left out: notes.txt: not a photo"
    assert lines[5:7] == [f"            not placed: {name}.jpg: too few matches" for name in "cd"]
    assert lines[7] == "beware      marker a 3 contradicts the 2 others"
    assert lines[8:11] == [f"{label:12}{finished.out}/{name}  2 kB" for label, name in (
        ("open", "report.html"), ("", "model.glb"), ("", "model.ply"))]  # fmt: skip
    assert lines[11] == "took        4 min; -v prints everything that was found"


def test_what_was_there_before_is_not_counted_as_work(finished):
    assert outcome_lines(finished, 65.0)[-1].startswith("took        65 s, 4 min with what was there; ")


def test_of_many_only_the_first_few_are_named(finished):
    scene = replace(finished.scene, unregistered={f"{k:02}.jpg": "no match" for k in range(40)})
    lines = outcome_lines(replace(finished, scene=scene), 250.0)

    assert sum("not placed" in line for line in lines) == 2
    assert any(line.strip() == "and 38 more photos; -v prints them" for line in lines)
    assert len(lines) < 20


@pytest.mark.parametrize(
    ("after", "says"), [(True, "only all photos together do"), (False, "this is a guess: an orbit")]
)
def test_a_camera_that_pairs_do_not_determine_is_called_so(finished, after, says):
    guess = Calibration(K, 1000, 800, "guess", False, "an orbit")
    run = replace(finished, calibration=Intrinsics({"one": guess}), scene=finished.scene if after else None)

    [line] = [line.strip() for line in outcome_lines(run, 250.0) if "pairs of photos" in line]

    assert line == f"pairs of photos do not determine it, {says}"


def test_a_camera_of_no_placed_photo_is_not_told(finished):
    guess = Calibration(K, 640, 480, "guess", False, "0 usable pairs")
    text = "\n".join(outcome_lines(replace(finished, calibration=Intrinsics({"two": guess, "one": KNOWN})), 250.0))

    assert "camera      focal 501.0" in text and "0 usable pairs" not in text


def test_a_size_that_is_not_known_is_asked_for(finished):
    stages = {**finished.manifest["stages"], "scale": {"counts": {**SIZE, "unit": ""}, "seconds": 1.0}}
    [size] = [
        line for line in outcome_lines(replace(finished, manifest={"stages": stages}), 250.0) if line[:4] == "size"
    ]

    assert '"measure" in the report' in size and len(size) <= 80


def test_a_run_that_was_stopped_early_says_how_far_it_came(finished):
    earlier = replace(finished, mesh_path=None)
    assert outcome_lines(earlier, 250.0)[0] == "Cameras and points of 2 of 4 photos."
    assert outcome_lines(replace(earlier, scene=None), 250.0)[0] == "The camera of 4 photos."
    assert outcome_lines(replace(earlier, scene=None, calibration=None), 250.0)[0] == "4 usable photos."
