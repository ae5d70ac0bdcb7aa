"""Parts of report.html that need no run."""

import json
import math
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import sfm_app
from sfm_app.frame.scale import SurveyedPoint
from sfm_app.report.findings import (
    ALL_PIXELS,
    LARGEST_PX,
    SMALLEST_PX,
    camera_tables,
    changed_settings,
    correlation_table,
    correlation_text,
    glance,
    picture_side,
    survey_rows,
    unknown_cameras,
    value_text,
)
from sfm_app.report.page import script_data, three_script
from sfm_app.report.scene_view import LIGHT_PAGE_PX, lighten
from sfm_app.report.text import duration_text
from sfm_app.settings import Settings
from sfm_app.types import Calibration, CameraModel, Intrinsics


def test_three_js_comes_from_an_installed_package_and_ends_before_the_page_that_it_was_in():
    script = three_script()
    assert 500_000 < len(script) < 2_000_000
    assert "WebGLRenderer" in script and "GLTFLoader" in script
    assert "B64GLTF" not in script and "</script" not in script.lower()


@pytest.mark.parametrize(
    "text", ["</script><script>alert(1)</script>", "<!--", "a\u2028b", "<img src=x onerror=alert(1)>"]
)
def test_no_text_ends_the_data_of_the_script(text):
    data = str(script_data({"name": text}))
    assert "<" not in data and "\u2028" not in data
    assert json.loads(data) == {"name": text}


@pytest.mark.parametrize("count", [1, 20, 200, 5000])
def test_pictures_of_any_number_of_photos_stay_small(count):
    side = picture_side(count)
    assert SMALLEST_PX <= side <= LARGEST_PX
    assert count * side * side * 3 / 4 < max(1.4 * ALL_PIXELS, count * SMALLEST_PX**2)


def test_few_photos_have_larger_pictures_than_many():
    assert picture_side(5) > picture_side(50) > picture_side(250)


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0 s"), (119, "119 s"), (150, "2 min"), (7300, "2.0 h")])
def test_durations_are_said_in_a_fitting_unit(seconds, text):
    assert duration_text(seconds) == text


def test_a_value_has_its_deviation_only_where_it_is_known():
    assert value_text(1379.16, 1.05) == "1379.2 ± 1.1"
    assert value_text(-0.00076, None, 4) == "-0.0008"


def test_control_points_and_check_points_stand_in_one_table_in_millimeters():
    used = SurveyedPoint("p1", "used", 3, 0.0102, -0.02)
    checks = [SurveyedPoint("CHK-1", "check", 2, 0.01, height, 0.01, 0.02) for height in (0.03, 0.07)]
    assert survey_rows([used, *checks]) == [
        ("p1", "used", "3", "10.2", "-20.0"),
        ("CHK-1", "check, inside", "2", "10.0 ± 10.0", "30.0 ± 20.0"),
        ("CHK-1", "check, outside", "2", "10.0 ± 10.0", "70.0 ± 20.0"),
    ]


def test_settings_that_were_changed_are_listed_with_their_defaults():
    given = Settings.from_mapping({"seed": 3, "mesh": {"faces": 1000}}).model_dump()
    contents = SimpleNamespace(manifest={"settings": given})
    assert changed_settings(contents) == [("mesh.faces", "1000", str(Settings().mesh.faces)), ("seed", "3", "0")]


def test_an_output_folder_whose_name_is_no_text_has_a_report(tmp_path):
    out = tmp_path / os.fsdecode(b"o\xff")
    try:
        out.mkdir()
    except OSError:
        pytest.skip("names of files are text here")
    photos = tmp_path / "photos"
    photos.mkdir()
    for seed in range(2):
        pixels = np.random.default_rng(seed).integers(0, 255, (96, 128, 3), np.uint8)
        Image.fromarray(pixels).save(photos / f"{seed}.png")
    sfm_app.reconstruct(photos, out, last="photos")
    assert "2 usable photos" in (out / "report.html").read_text(encoding="utf-8")


def test_nothing_is_claimed_of_a_run_without_a_stage():
    contents = SimpleNamespace(scene=None, intrinsics=None, stages={}, counts=lambda _: {})
    assert glance(contents) == []


def test_a_camera_that_pairs_do_not_determine_comes_with_what_to_do():
    camera = Calibration(np.diag([768.0, 768.0, 1.0]), 640, 480, "guess", identifiable=False, reason="an orbit")
    known = replace(camera, identifiable=True, method="zero-curves")
    contents = SimpleNamespace(intrinsics=SimpleNamespace(cameras={"a": known, "b": camera}), scene=None)

    [text] = unknown_cameras(contents)

    assert text.startswith("Pairs of photos do not determine the camera b: an orbit. A focal of 768 px is a guess. ")
    assert "What to do: add photos" in text


def test_a_scene_states_how_sure_its_cameras_are():
    guess = Calibration(np.diag([768.0, 768.0, 1.0]), 640, 480, "guess", identifiable=False, reason="an orbit")
    intrinsics = SimpleNamespace(cameras={"a": guess, "b": guess})
    assert len(unknown_cameras(SimpleNamespace(intrinsics=intrinsics, scene=None))) == 2
    assert unknown_cameras(SimpleNamespace(intrinsics=intrinsics, scene=SimpleNamespace())) == []


def test_cameras_that_mapping_made_of_one_have_a_table_each():
    K = np.diag([768.0, 768.0, 1.0])
    intrinsics = Intrinsics({"a": Calibration(K, 640, 480, "guess", identifiable=False)}, {"1.jpg": "a", "2.jpg": "a"})
    refined = {
        name: CameraModel("OPENCV", (focal, focal, 320.0, 240.0, *[0.0] * 4), np.diag([focal, focal, 1.0]), 640, 480)
        for name, focal in (("a", 700.0), ("a #2", 800.0))
    }
    scene = SimpleNamespace(cameras=refined, camera_of={"1.jpg": "a", "2.jpg": "a #2"})
    tables = camera_tables(SimpleNamespace(intrinsics=intrinsics, scene=scene, counts=lambda _: {}))
    assert [(table.name, *table.rows[0]) for table in tables] == [
        ("a", "fx", "768.0", "700.0"),
        ("a #2", "fx", "768.0", "800.0"),
    ]


@pytest.mark.parametrize(("unusable", "more"), [(0, ""), (2, "and 2 unusable")])
def test_photos_that_were_left_out_are_counted_beside_those_that_are_placed(unusable, more):
    counts = {"photos": {"unusable": {str(k): "blurred" for k in range(unusable)}}}
    scene = SimpleNamespace(
        registered={"a": 0}, unregistered={"b": ""}, cameras={}, points=5, observations=9, mean_reprojection_px=0.5
    )
    contents = SimpleNamespace(
        scene=scene, intrinsics=None, stages={}, counts=lambda stage: counts.get(stage, {}), is_metric=False
    )

    first = glance(contents)[0]

    assert (first.value, first.note) == ("1 of 2", more)


@pytest.mark.slow
def test_a_large_texture_is_shrunk_and_keeps_its_colors(textured_ball):
    large = np.full((3 * LIGHT_PAGE_PX, 2 * LIGHT_PAGE_PX, 3), (10, 120, 240), np.uint8)
    small = large[:64, :96]

    first, second = lighten(
        replace(textured_ball, texture=replace(textured_ball.texture, pages=(large, small)))
    ).texture.pages

    assert max(first.shape[:2]) == LIGHT_PAGE_PX and math.isclose(first.shape[0] / first.shape[1], 1.5, rel_tol=0.01)
    assert (first == (10, 120, 240)).all()
    assert second is small


def test_normal_maps_are_shrunk_with_their_pages(lit_ball):
    large = np.full((LIGHT_PAGE_PX, 2 * LIGHT_PAGE_PX, 3), (128, 128, 255), np.uint8)
    small = lit_ball.texture.normal_maps[1]
    maps = lighten(replace(lit_ball, texture=replace(lit_ball.texture, normal_maps=(large, small)))).texture.normal_maps
    assert maps[0].shape == (LIGHT_PAGE_PX // 4, LIGHT_PAGE_PX // 2, 3) and (maps[0] == (128, 128, 255)).all()
    assert maps[1] is small


PAIRS = Calibration(
    np.eye(3), 640, 480, "zero-curves", True, held=("aspect",),
    correlations={"fx fy": 0.99, "fx cx": 0.1, "fx cy": -0.2, "fx k1": 0.94, "cx cy": 0.0, "cx k1": 0.3,
                  "cy k1": -0.61},
)  # fmt: skip


def adjusted(determined, params, **correlations):
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    values = {key.replace("_", " "): value for key, value in correlations.items()}
    return CameraModel("OPENCV", params, np.eye(3), 640, 480, dict.fromkeys(names, 1.0), determined, values)


def test_correlations_of_the_free_parameters_are_a_lower_triangle():
    table = correlation_table(PAIRS, None)

    assert table.source == "from pairs of photos"
    assert list(table.names) == ["focal", "cx", "cy", "k1"]
    assert table.rows[3] == [0.94, 0.3, -0.61, None] and table.rows[1] == [0.1, None, None, None]
    assert correlation_text(table.rows[3][2]) == "\N{MINUS SIGN}0.61"


def test_the_last_adjustment_counts_and_terms_that_are_zero_do_not():
    params = (900.0, 800.0, 320.0, 240.0, -0.1, 0.0, 1e-4, -1e-4)
    table = correlation_table(PAIRS, adjusted(("aspect", "k1"), params, fx_fy=0.4, fx_k1=-0.3, k1_p1=0.2, fx_k2=0.9))
    assert table.source == "after the last adjustment"
    assert list(table.names) == ["fx", "fy", "cx", "cy", "k1", "p1", "p2"]
    assert table.rows[1][0] == 0.4 and table.rows[4][0] == -0.3


def test_nothing_is_said_where_nothing_is_known():
    guess = Calibration(np.eye(3), 640, 480, "guess", False, correlations=PAIRS.correlations)
    assert correlation_table(guess, None) is None
    assert correlation_table(guess, adjusted((), (0.0,) * 8, fx_k1=0.9)) is None
