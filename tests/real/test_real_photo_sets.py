"""Real photos, where SFM_APP_DATA names a folder that has them: NAME/images and NAME/cameras.json."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

import sfm_app

DATA = Path(os.environ.get("SFM_APP_DATA", ""))


def photo_set(name):
    if not os.environ.get("SFM_APP_DATA") or not (DATA / name / "images").is_dir():
        pytest.skip(f"SFM_APP_DATA names no folder with {name}")
    return DATA / name / "images"


def test_kermit11_runs_to_a_mesh(tmp_path):
    draft = sfm_app.Settings.from_mapping({"quality": "draft"})
    run = sfm_app.reconstruct(photo_set("kermit11"), tmp_path / "out", draft)

    assert len(run.scene.registered) == 11
    assert run.scene.points > 500
    assert 0.1 < run.scene.mean_reprojection_px < 0.5
    assert run.mesh_path.stat().st_size > 100_000
    assert run.manifest["stages"]["mesh"]["counts"]["triangles"] > 10_000


def test_herz_jesus_is_calibrated_without_exif():
    folder = photo_set("Herz-Jesus-P8")
    truth = np.array(json.loads((DATA / "Herz-Jesus-P8" / "cameras.json").read_text())["images"][0]["K"])

    found = sfm_app.calibrate_photos(folder, sfm_app.Settings.from_mapping({"quality": "draft"}))

    assert found.identifiable
    assert found.main.focal_px == pytest.approx(truth[0, 0], rel=0.01)
    assert np.hypot(*(found.K[:2, 2] - truth[:2, 2])) < 0.02 * 1536


def test_temple16_stands_upright_though_all_its_photos_lie_on_their_side(tmp_path):
    no_report = sfm_app.Settings.from_mapping({"report": False})
    run = sfm_app.reconstruct(photo_set("temple16"), tmp_path / "out", no_report, last="scene")
    orientation = run.manifest["stages"]["scene"]["counts"]["orientation"]

    assert orientation["photos_turned_deg"] == 270, "the steps are on the left in most photos"
    assert 10 < orientation["up_sign_odds"] < 1e5
    assert orientation["up_deviation_deg"] < 2
