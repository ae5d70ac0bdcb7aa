"""The result of a run as text and as plain values, and the next commands."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from sfm_app.api import Run
from sfm_app.camera.models import camera_matrix
from sfm_app.cli import commands
from sfm_app.cli.commands import SCENES
from sfm_app.cli.outcome import demo_steps, outcome_lines, run_lines, run_steps, run_summary
from sfm_app.cli.output import print_text
from sfm_app.cli.program import main
from sfm_app.demo import DemoResult, demo_lines
from sfm_app.report.text import contradiction_lines, intrinsics_lines, intrinsics_summary, refined_text
from sfm_app.settings import Settings
from sfm_app.types import Calibration, CameraModel, Intrinsics, Scene
from tests.unit.cli.test_terminal import LONG, check_text

K = camera_matrix(500.0, 510.0, 480.0, 410.0)
KNOWN = Calibration(
    K, 1000, 800, "zero-curves", True,
    distortion=(-0.05,), spread={"fx": 1.25, "fy": 2.0, "cx": 3.0, "cy": 4.0, "k1": 0.01}, held=("aspect",),
    key_pairs=((1, 2), (2, 3), (3, 4), (4, 5)),
)  # fmt: skip
GUESS = Calibration(K, 1000, 800, "guess", False, "an orbit", held=("center",))
REFINED = CameraModel("OPENCV", (501.0, 510.0, 480.0, 410.0, 0, 0, 0, 0), K, 1000, 800, {"fx": 0.754})
SCALE = {"unit": "meter", "deviation_percent": 0.12, "source": "marker a 1, marker a 2",
         "contradictions": ["marker a 3 contradicts the 2 others"], "problems": []}  # fmt: skip


def manifest(counts):
    return {"stages": {name: {"counts": part, "seconds": 60.0} for name, part in counts.items()}}


@pytest.fixture
def finished(tmp_path):
    """A run with a model of two photos of four."""
    for name in ("report.html", "model.glb", "model.ply"):
        (tmp_path / name).write_bytes(bytes(2000))
    counts = {
        "photos": {"usable": 4, "unusable": {"notes.txt": "not a photo"}},
        "scale": SCALE,
        "mesh": {"triangles": 12_345},
        "files": {"bytes": {"model.ply": 2000, "model.glb": 2000}},
    }
    poses = {name: np.eye(3, 4) for name in ("a.jpg", "b.jpg")}
    missing = {"c.jpg": "too few matches", "d.jpg": "too few matches"}
    scene = Scene(tmp_path, poses, missing, {"one": REFINED}, 10, 20, 0.312)
    cameras = Intrinsics({"one": KNOWN}, dict.fromkeys(poses, "one"))
    return Run(tmp_path, cameras, scene, None, tmp_path / "model.glb", manifest(counts), tmp_path / "report.html")


@pytest.fixture
def long_run(finished):
    """A run with long names, reasons and warnings."""
    counts = {
        "photos": {
            "usable": 4, "unusable": {f"file {k}.txt": "not a photo" for k in range(30)}, "notes": {"a.jpg": [LONG]},
        },
        "view_graph": {"kept": 5, "rejected": {f"reason {k} of some length": k for k in range(12)}},
        "scale": {**SCALE, "source": LONG, "contradictions": [LONG]},
        "mesh": {"triangles": 12_345},
        "files": {"bytes": {"model.ply": 2, "model.glb": 2}, "pages_px": [[4096, 4096]] * 6, "jpeg_quality": 90},
    }  # fmt: skip
    guess = Intrinsics({"one": replace(GUESS, reason=LONG)}, dict.fromkeys(("a.jpg", "b.jpg"), "one"))
    scene = replace(finished.scene, unregistered={"c.jpg": LONG})
    return replace(finished, calibration=guess, scene=scene, manifest=manifest(counts))


@pytest.mark.parametrize("lines_of", [run_lines, partial(outcome_lines, seconds=0.7)], ids=["all", "outcome"])
@pytest.mark.parametrize("until", ["photos", "camera", "scene", "mesh"])
def test_the_result_fits_into_80_columns(capsys, long_run, lines_of, until):
    products = ("calibration", "scene", "mesh_path")
    missing = products[["photos", "camera", "scene", "mesh"].index(until) :]
    print_text(lines_of(replace(long_run, **dict.fromkeys(missing))))
    check_text(capsys.readouterr().out, str(long_run.out))


@pytest.mark.parametrize("scene", SCENES)
def test_the_result_of_a_demo_fits_into_80_columns(capsys, scene):
    truth = camera_matrix(1008.0, 1007.99, 508.8, 1307.2).tolist()
    files = ["demo/model/report.html", "demo/model/model.glb", "demo/model/model.ply", f"demo-{scene}/model.png"]
    errors = (10.012, 0.005, 0.03, 0.017, 0.022, 99.5, 96.2)
    print_text(demo_lines(DemoResult(20, 19, truth, truth, truth, *errors, 199_999, [], 50.0, 130.0, files)))
    text = capsys.readouterr().out
    check_text(text)
    assert len(text.splitlines()) <= 7


def test_the_outcome_is_result_accuracy_warnings_and_files(finished):
    lines = outcome_lines(finished, 250.0)

    assert lines[0] == "A model of 2 of 4 photos, with 12,345 triangles."
    assert lines[1] == "accuracy    mean reprojection error 0.31 px"
    assert lines[2].startswith("camera      focal 501.0 +- 0.75 px, sees 90 degrees")
    assert lines[3] == "size        in meters, +- 0.12 %, by marker a 1, marker a 2"
    assert lines[4] == "missing     left out: notes.txt: not a photo"
    assert lines[5:7] == [f"            not placed: {name}.jpg: too few matches" for name in "cd"]
    assert lines[7] == "beware      marker a 3 contradicts the 2 others"
    assert lines[8:11] == [f"{label:12}{finished.out}/{name}  2 kB" for label, name in (
        ("open", "report.html"), ("", "model.glb"), ("", "model.ply"))]  # fmt: skip
    assert lines[11:] == ["took        4 min; -v prints all results"]


def test_stages_of_earlier_runs_are_told_apart(finished):
    assert outcome_lines(finished, 65.0)[-1].startswith("took        65 s, 4 min with earlier runs; ")


def test_only_the_first_missing_photos_are_named(finished):
    scene = replace(finished.scene, unregistered={f"{k:02}.jpg": "no match" for k in range(40)})
    lines = outcome_lines(replace(finished, scene=scene), 250.0)
    assert sum("not placed" in line for line in lines) == 2
    assert any(line.strip() == "and 38 more photos; -v prints them" for line in lines) and len(lines) < 20


@pytest.mark.parametrize(
    ("deviation", "text"),
    [(16.0, "all photos together do"), (18.0, "nor do all photos together"), (None, "this is a guess: an orbit")],
)
def test_a_camera_that_pairs_do_not_determine_is_marked(finished, deviation, text):
    refined = {"one": replace(REFINED, deviations={"fx": deviation})}
    scene = None if deviation is None else replace(finished.scene, cameras=refined)
    run = replace(finished, calibration=Intrinsics({"one": GUESS}), scene=scene)
    [line] = [line.strip() for line in outcome_lines(run, 250.0) if "pairs of photos" in line]
    assert line == f"pairs of photos do not determine it; {text}"


def test_a_camera_of_missing_photos_is_not_shown(finished):
    guess = Calibration(K, 640, 480, "guess", False, "0 usable pairs")
    text = "\n".join(outcome_lines(replace(finished, calibration=Intrinsics({"two": guess, "one": KNOWN})), 250.0))
    assert "camera      focal 501.0" in text and "0 usable pairs" not in text


def test_both_cameras_are_shown_that_mapping_made_of_one(finished):
    scene = replace(
        finished.scene, cameras={"one": REFINED, "one #2": REFINED}, camera_of={"a.jpg": "one", "b.jpg": "one #2"}
    )
    calibration = Intrinsics({"one": GUESS}, dict.fromkeys(("a.jpg", "b.jpg"), "one"))
    lines = outcome_lines(replace(finished, calibration=calibration, scene=scene), 250.0)
    assert [line[:26].strip() for line in lines if line.startswith("camera ")] == [
        "camera      one: focal 501",
        "camera      one #2: focal",
    ]
    assert sum("pairs of photos do not determine it" in line for line in lines) == 2


def test_only_the_first_cameras_are_shown(finished):
    cameras = Intrinsics({f"camera {k}": KNOWN for k in range(5)})
    lines = outcome_lines(replace(finished, calibration=cameras, scene=None), 250.0)
    assert sum(line.startswith("camera      camera ") for line in lines) == 3
    assert "            and 2 more cameras" in lines


def test_an_unknown_scale_names_the_remedy(finished):
    stages = {**finished.manifest["stages"], "scale": {"counts": {**SCALE, "unit": ""}, "seconds": 1.0}}
    lines = outcome_lines(replace(finished, manifest={"stages": stages}), 250.0)
    [size] = [line for line in lines if line.startswith("size")]
    assert "measure it in the report" in size and len(size) <= 80


def test_a_run_of_some_stages_has_its_own_headline(finished):
    earlier = replace(finished, mesh_path=None)
    everything = replace(finished.scene, unregistered={})
    assert outcome_lines(earlier, 250.0)[0] == "Cameras and points of 2 of 4 photos."
    assert outcome_lines(replace(earlier, scene=everything), 250.0)[0] == "Cameras and points of all 2 photos."
    assert outcome_lines(replace(earlier, scene=None), 250.0)[0] == "The camera of 4 photos."
    assert outcome_lines(replace(earlier, scene=None, calibration=None), 250.0)[0] == "4 usable photos."


def test_every_parameter_stands_beside_its_deviation():
    first, *others = intrinsics_lines(Intrinsics({"one": KNOWN}, photos={1: "a.jpg", 2: "b.jpg", 3: "c.jpg"}))
    assert first == "camera      fx 500.0 +- 1.2  fy 510.0 +- 2.0  cx 480.0 +- 3.0  cy 410.0 +- 4.0 px"
    assert [line.strip() for line in others] == [
        "sees 93 degrees from left to right, 78 from top to bottom",
        "The lens bends lines outwards (barrel), k1 -0.050 +- 0.010.",
        "Assumed, since the photos do not determine it: square pixels.",
        "best initial pairs of photos: a.jpg + b.jpg, b.jpg + c.jpg, c.jpg + 4",
    ]


def test_a_given_camera_is_marked():
    lines = intrinsics_lines(Intrinsics({"one": replace(KNOWN, method="kept"), "two": replace(KNOWN, method="given")}))
    assert [line.strip() for line in lines if "as given" in line] == ["as given, and kept", "as given, to be refined"]


def test_refined_cameras_have_their_field_of_view():
    focal = 500.0 / np.radians(60.0)
    fisheye = CameraModel("OPENCV_FISHEYE", (focal, focal, 500, 400, 0, 0, 0, 0), K, 1000, 800, {"fx": 1.0})
    panorama = CameraModel("EQUIRECTANGULAR", (1000.0, 500.0), K, 1000, 500)
    plain = CameraModel("OPENCV", (500, 510, 480, 410, 0, 0, 0, 0), K, 1000, 800)
    assert refined_text(fisheye).endswith("; a fisheye that sees 120 degrees from left to right, 96 from top to bottom")
    assert refined_text(panorama) == "360-degree panoramas, 1000 x 500 px"
    assert refined_text(plain) == "fx 500.0  fy 510.0  cx 480.0  cy 410.0 px"


def test_a_warning_of_a_contradicted_camera_has_both_numbers():
    counts = {"given_cameras": {"a": {"contradicted": [{"text": "focal length: given 9 px, the photos say 8 px"}]}}}
    assert contradiction_lines(counts) == [
        "beware: the photos contradict the given camera a: focal length: given 9 px, the photos say 8 px"
    ]
    assert contradiction_lines({}) == []
    assert contradiction_lines({"given_camera_notes": ["it is scaled"]}) == ["it is scaled"]
    claims = {"a": {"text": "EXIF says 9 px"}, "b": {"contradicted": False}}
    assert contradiction_lines({"camera_claims": claims}) == ["a: EXIF says 9 px"]


def test_a_guess_is_marked_right_after_its_figures():
    lines = intrinsics_lines(Intrinsics({"one": GUESS, "two": KNOWN}))
    assert lines[0].startswith("camera      one: fx 500.0  fy 510.0")
    assert lines[1].strip() == "these photos do not determine it (an orbit): a guess"
    assert sum(line.startswith("camera ") for line in lines) == 2


def test_each_of_several_cameras_names_its_photos():
    cameras = {**{f"{key}.jpg": "one" for key in range(6)}, "z.jpg": "one #2"}
    lines = [line.strip() for line in intrinsics_lines(Intrinsics({"one": KNOWN, "one #2": KNOWN}, cameras))]
    assert "took 0.jpg, 1.jpg, 2.jpg, 3.jpg and 2 more" in lines and "took z.jpg" in lines


def test_json_has_every_figure_of_a_camera():
    camera = json.loads(json.dumps(intrinsics_summary(Intrinsics({"one": KNOWN}))))["one"]
    assert camera["field_of_view_deg"] == pytest.approx([93.27, 78.07], abs=0.01)
    changed = dict.fromkeys(("field_of_view_deg", "key_pairs"))
    assert camera | changed == KNOWN.to_dict() | changed
    assert (camera["distortion"], camera["spread"]["k1"], camera["held"]) == ([-0.05], 0.01, ["aspect"])
    assert (camera["identifiable"], camera["reason"], camera["key_pairs"][0]) == (True, "", ["1", "2"])


def test_refined_cameras_stand_with_their_deviations(tmp_path):
    deviations = {"fx": 0.75, "fy": 1.5, "cx": 2.0, "cy": 2.5, "k1": 0.01}
    camera = CameraModel("OPENCV", (500.0, 510.0, 480.0, 410.0, -0.05, 0, 0, 0), K, 1000, 800, deviations, ("center",))
    run = Run(tmp_path, None, Scene(tmp_path, {}, {}, {"one": camera}, 10, 20, 0.3), None, None, {})
    line = "camera refined: fx 500.0 +- 0.8  fy 510.0 +- 1.5  cx 480.0 +- 2.0  cy 410.0 +- 2.5 px"
    assert line in map(str.strip, run_lines(run))
    summary = json.loads(json.dumps(run_summary(run)))["scene"]["cameras"]["one"]
    assert summary["deviations"] == deviations and summary["determined"] == ["center"]
    assert summary["K"] == K.tolist() and summary["params"][4] == -0.05


def test_model_files_stand_with_their_sizes_the_one_to_open_first(tmp_path):
    sizes = {"model.ply": 2_340_000, "model.glb": 4_000, "points.ply": 10, "points.glb": 20}
    for name in ("model.ply", "model.glb", "points.glb"):
        (tmp_path / name).write_bytes(bytes(sizes[name]))
    points, models = ({name: sizes[name] for name in sizes if name[0] == first} for first in "pm")
    counts = {
        "scale": {"bytes": points, "unit": "arbitrary", "contradictions": [], "problems": []},
        "mesh": {"triangles": 7},
        "files": {"bytes": models, "pages_px": [[4096, 2048], [512, 512]], "jpeg_quality": 90},
    }
    scene = Scene(tmp_path, {}, {}, {}, 10, 20, 0.3)
    run = Run(tmp_path, None, scene, None, tmp_path / "model.glb", manifest(counts))

    lines = [line.strip() for line in run_lines(run)]
    start = lines.index("mesh        7 triangles, texture 4096 x 2048 and 512 x 512 px, JPEG quality 90")
    assert lines[start + 1 : start + 3] == [f"{tmp_path}/model.glb  4 kB", f"{tmp_path}/model.ply  2.3 MB"]
    assert lines[start - 1] == f"points      {tmp_path}/points.glb  20 bytes"
    assert lines[-1] == "seconds     scale 60.0, mesh 60.0, files 60.0; total 180.0"
    scene, mesh = (run_summary(run)[part]["files"] for part in ("scene", "mesh"))
    assert scene == [f"{tmp_path}/points.glb"] and mesh == [f"{tmp_path}/model.glb", f"{tmp_path}/model.ply"]


PHOTOS, OUT = Path("my photos"), Path("out")
MODEL = Run(OUT, None, None, None, OUT / "model.glb", {})


def test_next_commands_can_be_copied():
    lines = run_steps(MODEL, [PHOTOS], None, Settings())
    assert lines[0].startswith("next        sfm-app view out")
    assert lines[1].startswith("            sfm-app run 'my photos' --quality high")
    assert lines[2].startswith("            sfm-app export out --format obj")
    assert len(lines) == 3 and max(map(len, lines)) <= 80 and len({line.rindex("  ") for line in lines}) == 1
    assert "sfm-app run 'my photos' -o out --quality high" in "\n".join(run_steps(MODEL, [PHOTOS], OUT, Settings()))
    assert {"--quality", "-o"} <= {flag for parameter in commands.run.params for flag in parameter.opts}


def test_long_commands_have_their_purpose_below():
    lines = run_steps(MODEL, [Path("a" * 60)], None, Settings())
    assert len(lines) == 6 and all(line.startswith("              ") for line in lines[1::2])
    assert not any(line.startswith("              ") for line in lines[::2])


def test_the_next_commands_depend_on_the_run():
    best = Settings.from_mapping({"quality": "high", "scale": {"markers": "50mm"}})
    assert not any("finer" in line for line in run_steps(MODEL, [PHOTOS], None, best))
    stopped = Run(OUT, None, None, None, None, {})
    assert ["continue to the model" in line for line in run_steps(stopped, [PHOTOS], None, best)] == [True]


@pytest.mark.parametrize(("scene", "other"), [("courtyard", "statue"), ("statue", "fisheye")])
def test_after_a_demo_come_another_one_and_own_photos(scene, other):
    lines = demo_steps(MODEL, scene)
    assert "sfm-app view out" in lines[0] and f"sfm-app demo --scene {other}" in lines[1]
    assert "sfm-app run PHOTOS" in lines[2] and max(map(len, lines)) <= 80


@pytest.mark.parametrize(
    ("flags", "terminal", "printed"), [([], True, True), (["-q"], True, False), ([], False, False)]
)
def test_next_commands_are_printed_on_a_terminal_only(monkeypatch, finished, flags, terminal, printed):
    monkeypatch.setattr("sfm_app.reconstruct", lambda *_, **__: finished)
    monkeypatch.setattr(commands, "sys", SimpleNamespace(stdout=SimpleNamespace(isatty=lambda: terminal)))
    result = CliRunner().invoke(main, ["run", "photos", "-o", "out", *flags])
    assert result.exit_code == 0 and result.stdout.startswith("A model of 2 of 4 photos")
    assert ("\nnext        sfm-app view" in result.stdout) is printed
