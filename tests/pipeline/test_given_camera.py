"""A rendered folder with a camera that the user knows: kept to the last bit, refined, or of a named model."""

import json

import numpy as np
import pytest

from sfm_app.api import reconstruct
from sfm_app.settings import Settings

pytestmark = pytest.mark.slow


def run(photos, out, **values):
    settings = {key: values.pop(key) for key in ("scene",) if key in values}
    return reconstruct(
        photos, out, Settings.from_mapping({**settings, "calibration": values, "report": False}), last="scene"
    )


def contradicted(done, stage):
    [camera] = done.manifest["stages"][stage]["counts"]["given_cameras"].values()
    assert camera["checked"]
    return [one["what"] for one in camera["contradicted"]]


def test_a_given_camera_is_kept_or_refined_and_checked(rendered, tmp_path):
    photos, truth = rendered
    f, cx, cy = truth.K[0, 0], truth.K[0, 2], truth.K[1, 2]
    size = {"width": 960, "height": 640}
    K = [[2 * f, 0, 2 * cx - 0.5], [0, 2 * f, 2 * cy - 0.5], [0, 0, 1]]
    file = tmp_path / "camera.json"
    file.write_text(json.dumps({"camera_matrix": K, "dist_coeffs": [0, 0, 0, 0], **size}))

    kept = run(photos, tmp_path / "out", file=str(file), keep=True)

    [camera] = kept.scene.cameras.values()
    assert camera.params == (f, f, cx, cy, 0.0, 0.0, 0.0, 0.0) and camera.deviations == {}
    assert (kept.calibration.main.method, kept.calibration.main.focal_px) == ("kept", pytest.approx(f))
    assert contradicted(kept, "intrinsics") == contradicted(kept, "scene") == []
    assert len(kept.scene.registered) == len(truth.cam_from_world)

    K[0][0] = K[1][1] = 2 * 1.15 * f
    file.write_text(json.dumps({"K": K, **size}))
    wrong = run(photos, tmp_path / "out", file=str(file), keep=False)

    [camera] = wrong.scene.cameras.values()
    assert abs(camera.K[0, 0] / f - 1.0) < 0.01 and wrong.calibration.main.method == "given"
    assert contradicted(wrong, "intrinsics")[0] == contradicted(wrong, "scene")[0] == "focal length"
    assert kept.manifest["stages"]["match_graph"] == wrong.manifest["stages"]["match_graph"]


def test_the_named_model_is_the_last_one(rendered, tmp_path):
    photos, truth = rendered

    done = run(photos, tmp_path / "out", scene={"camera_model": "RADIAL"})

    [lens] = done.manifest["stages"]["scene"]["counts"]["lenses"].values()
    [camera] = done.scene.cameras.values()
    assert (lens["model"], lens["file"]) == ("RADIAL", "OPENCV")
    assert np.count_nonzero(camera.params[4:6]) == 2 and camera.params[6:] == (0.0, 0.0)
    assert abs(camera.K[0, 0] / truth.K[0, 0] - 1.0) < 0.01
