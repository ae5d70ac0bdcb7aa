import json
from dataclasses import replace

import numpy as np
import pytest

from sfm_app.api import Run
from sfm_app.cli.display import intrinsics_lines, intrinsics_summary, run_lines, run_summary
from sfm_app.cli.output import size_text
from sfm_app.geometry.camera import camera_matrix, panorama_matrix
from sfm_app.report.camera_text import contradiction_lines, refined_text
from sfm_app.types import Calibration, CameraModel, Intrinsics, Scene

K = camera_matrix(500.0, 510.0, 480.0, 410.0)
KNOWN = Calibration(
    K, 1000, 800, "zero-curves", True,
    radial=-0.05, spread={"fx": 1.25, "fy": 2.0, "cx": 3.0, "cy": 4.0, "k1": 0.01}, held=("aspect",),
    key_pairs=((1, 2), (2, 3), (3, 4), (4, 5)),
)  # fmt: skip
GUESS = Calibration(K, 1000, 800, "guess", False, "an orbit", held=("center",))


def test_every_parameter_stands_beside_its_deviation():
    first, *others = intrinsics_lines(Intrinsics({"one": KNOWN}, photos={1: "a.jpg", 2: "b.jpg", 3: "c.jpg"}))

    assert first == "camera      fx 500.0 +- 1.2  fy 510.0 +- 2.0  cx 480.0 +- 3.0  cy 410.0 +- 4.0 px"
    assert [line.strip() for line in others] == [
        "sees 93 degrees from left to right, 78 from top to bottom",
        "The lens bends lines outwards (barrel), k1 -0.050 +- 0.010.",
        "Assumed, since the photos do not determine it: square pixels.",
        "best pairs of photos to start from: a.jpg + b.jpg, b.jpg + c.jpg, c.jpg + 4",
    ]


def test_a_fisheye_and_a_panorama_say_what_they_see():
    wide = camera_matrix(500.0 / np.radians(60.0), 500.0 / np.radians(60.0), 500.0, 400.0)
    fisheye = Calibration(wide, 1000, 800, "lens", True, projection="fisheye", fisheye=(0.0, 0.0, 0.0, 0.0))
    panorama = Calibration(panorama_matrix((1000, 500)), 1000, 500, "panorama", True, projection="equirectangular")

    lines = [line.strip() for line in intrinsics_lines(Intrinsics({"one": fisheye, "two": panorama}))]

    assert lines[1] == "a fisheye that sees 120 degrees from left to right, 96 from top to bottom"
    assert lines[2:] == ["camera      two: panoramas of a whole turn, 1000 x 500 px"]


def test_a_given_camera_is_called_so():
    lines = intrinsics_lines(Intrinsics({"one": replace(KNOWN, method="kept"), "two": replace(KNOWN, method="given")}))

    assert [line.strip() for line in lines if "as given" in line] == ["as given, and kept", "as given, to be refined"]


def test_refined_cameras_say_what_their_lens_sees():
    focal = 500.0 / np.radians(60.0)
    fisheye = CameraModel("OPENCV_FISHEYE", (focal, focal, 500, 400, 0, 0, 0, 0), K, 1000, 800, {"fx": 1.0})
    panorama = CameraModel("EQUIRECTANGULAR", (1000.0, 500.0), K, 1000, 500)
    plain = CameraModel("OPENCV", (500, 510, 480, 410, 0, 0, 0, 0), K, 1000, 800)

    assert refined_text(fisheye).endswith("; a fisheye that sees 120 degrees from left to right, 96 from top to bottom")
    assert refined_text(panorama) == "panoramas of a whole turn, 1000 x 500 px"
    assert refined_text(plain) == "fx 500.0  fy 510.0  cx 480.0  cy 410.0 px"


def test_a_contradicted_camera_is_warned_of_with_both_numbers():
    counts = {"given_cameras": {"a": {"contradicted": [{"text": "focal length: given 9 px, the photos say 8 px"}]}}}

    assert contradiction_lines(counts) == [
        "beware: the photos contradict the given camera a: focal length: given 9 px, the photos say 8 px"
    ]
    assert contradiction_lines({}) == []
    assert contradiction_lines({"given_camera_notes": ["it is scaled"]}) == ["it is scaled"]
    claims = {"a": {"text": "EXIF says 9 px"}, "b": {"contradicted": False}}
    assert contradiction_lines({"exif_focals": claims}) == ["a: EXIF says 9 px"]


def test_a_guess_is_called_one_right_after_its_figures():
    lines = intrinsics_lines(Intrinsics({"one": GUESS, "two": KNOWN}))

    assert lines[0].startswith("camera      one: fx 500.0  fy 510.0")
    assert lines[1].strip() == "these photos do not determine it (an orbit): a guess"
    assert sum(line.startswith("camera ") for line in lines) == 2


def test_of_several_cameras_each_names_its_photos():
    took = {**{f"{key}.jpg": "one" for key in range(6)}, "z.jpg": "one #2"}
    lines = [line.strip() for line in intrinsics_lines(Intrinsics({"one": KNOWN, "one #2": KNOWN}, took))]

    assert "took 0.jpg, 1.jpg, 2.jpg, 3.jpg and 2 more" in lines
    assert "took z.jpg" in lines


def test_json_holds_everything_that_is_known_of_a_camera():
    found = json.loads(json.dumps(intrinsics_summary(Intrinsics({"one": KNOWN}))))["one"]

    assert found["field_of_view_deg"] == pytest.approx([93.27, 78.07], abs=0.01)
    beside = ("field_of_view_deg", "key_pairs")
    assert {k: v for k, v in found.items() if k not in beside} == {
        k: v for k, v in KNOWN.to_dict().items() if k not in beside
    }
    assert (found["radial"], found["spread"]["k1"], found["held"]) == (-0.05, 0.01, ["aspect"])
    assert (found["identifiable"], found["reason"], found["key_pairs"][0]) == (True, "", ["1", "2"])


def test_refined_cameras_stand_with_their_deviations(tmp_path):
    deviations = {"fx": 0.75, "fy": 1.5, "cx": 2.0, "cy": 2.5, "k1": 0.01}
    camera = CameraModel("OPENCV", (500.0, 510.0, 480.0, 410.0, -0.05, 0, 0, 0), K, 1000, 800, deviations, ("center",))
    scene = Scene(tmp_path, {}, {}, {"one": camera}, 10, 20, 0.3)
    run = Run(tmp_path, None, scene, None, None, {})

    assert any(
        line.strip() == "camera refined: fx 500.0 +- 0.8  fy 510.0 +- 1.5  cx 480.0 +- 2.0  cy 410.0 +- 2.5 px"
        for line in run_lines(run)
    )
    found = json.loads(json.dumps(run_summary(run)))["scene"]["cameras"]["one"]
    assert found["deviations"] == deviations and found["determined"] == ["center"]
    assert found["K"] == K.tolist() and found["params"][4] == -0.05


def test_model_files_stand_with_their_sizes_the_one_to_open_first(tmp_path):
    sizes = {"model.ply": 2_340_000, "model.glb": 4_000, "points.ply": 10, "points.glb": 20}
    for name, size in sizes.items():
        (tmp_path / name).write_bytes(bytes(size))
    (tmp_path / "points.ply").unlink()
    counts = {
        "scale": {
            "bytes": {name: sizes[name] for name in ("points.ply", "points.glb")},
            "unit": "arbitrary",
            "contradictions": [],
            "problems": [],
        },
        "mesh": {"triangles": 7},
        "files": {
            "bytes": {name: sizes[name] for name in ("model.ply", "model.glb")},
            "pages_px": [[4096, 2048], [512, 512]],
            "jpeg_quality": 90,
        },
    }
    stages = {name: {"counts": part, "seconds": 1.0} for name, part in counts.items()}
    scene = Scene(tmp_path, {}, {}, {}, 10, 20, 0.3)
    run = Run(tmp_path, None, scene, None, tmp_path / "model.glb", {"stages": stages})

    lines = [line.strip() for line in run_lines(run)]
    start = lines.index("mesh        7 triangles, texture 4096 x 2048 and 512 x 512 px, JPEG of quality 90")
    assert lines[start + 1 : start + 3] == [f"{tmp_path}/model.glb  4 kB", f"{tmp_path}/model.ply  2.3 MB"]
    assert lines[start - 2] == f"points and cameras: {tmp_path}/points.glb  {size_text(sizes['points.glb'])}"
    summary = run_summary(run)
    assert [summary[part]["files"] for part in ("scene", "mesh")] == [
        [f"{tmp_path}/points.glb"],
        [f"{tmp_path}/model.glb", f"{tmp_path}/model.ply"],
    ]


@pytest.mark.parametrize(
    ("size", "text"), [(0, "0 bytes"), (999, "999 bytes"), (355_764, "356 kB"), (15_133_688, "15.1 MB")]
)
def test_sizes_are_told_as_people_read_them(size, text):
    assert size_text(size) == text
