import json
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.cameras.score import Model, TruePhoto
from benchmarks.trouble import command as trouble
from sfm_app.camera.models import camera_matrix
from sfm_app.types import CameraModel, Scene

K = camera_matrix(600.0, 600.0, 320.0, 240.0)
LONG = camera_matrix(660.0, 660.0, 320.0, 240.0)
PHOTOS = {"a": TruePhoto(K, np.eye(3, 4), 640.0), "b": TruePhoto(LONG, np.eye(3, 4), 640.0)}


def left_behind(folder, *, identifiable, sd):
    before = {"640x480": {"identifiable": identifiable, "K": K.tolist(), "spread": {}}}
    after = {"640x480": {"K": LONG.tolist(), "deviations": {"fx": sd, "fy": sd}}}
    folder.mkdir(exist_ok=True)
    for name, cameras in (("calibration", before), ("scene", after)):
        document = {"cameras": cameras, "camera_of": {"a.jpg": "640x480", "b.jpg": "640x480"}}
        (folder / f"{name}.json").write_text(json.dumps(document))


def test_each_photo_is_held_against_the_camera_that_took_it(tmp_path):
    left_behind(tmp_path, identifiable=True, sd=1.0)
    found = trouble.known_cameras(tmp_path, PHOTOS, "before")
    assert (found["known"], found["wrong"]) == ("2/2", 1)
    assert found["focal %"] == pytest.approx(100 * (1 - 600 / 660), abs=0.01)


def test_what_is_called_a_guess_is_not_wrong(tmp_path):
    left_behind(tmp_path, identifiable=False, sd=100.0)
    truth = SimpleNamespace(
        cameras={f"{name}.jpg": SimpleNamespace(K=photo.K, width=640) for name, photo in PHOTOS.items()},
        cam_from_world={f"{name}.jpg": photo.pose for name, photo in PHOTOS.items()},
    )

    row = trouble.score_run(tmp_path, truth)

    assert (row["known"], row["focal %"], row["wrong"]) == ("0/2", None, 0)
    assert (row["known after"], row["wrong after"], row["beyond 3 sd"]) == ("0/2", 0, 0)
    assert (row["placed"], row["share placed"], row["models"]) == ("0/2", 0.0, 0)
    left_behind(tmp_path, identifiable=False, sd=1.0)
    row = trouble.score_run(tmp_path, truth)
    assert (row["known after"], row["wrong after"]) == ("2/2", 1)
    assert (row["stated"], row["beyond 3 sd"], row["worst in sd"]) == (2, 2, 30.0)
    assert trouble.score_run(tmp_path / "nothing", truth)["known"] == "0/2"


def test_a_photo_that_the_program_lays_on_its_side_is_held_against_its_turned_camera():
    photo = TruePhoto(camera_matrix(600.0, 700.0, 310.0, 250.0), np.eye(3, 4), 480.0)
    x, y, _ = photo.K @ [0.3, 0.1, 1.0]
    laid = trouble.lay(photo)
    u, v, w = laid.K @ laid.pose @ [0.3, 0.1, 1.0, 1.0]
    assert np.allclose([u, v, w], [y, 480.0 - x, 1.0])  # the upper right corner comes to the upper left
    assert np.allclose(laid.K, camera_matrix(700.0, 600.0, 250.0, 170.0))


def folder_row(seed=1, troubles="plane, zoom", **figures):
    fine = {
        "method": "sfm-app", "photos": f"{seed:05d}", "seed": seed,
        "troubles": troubles, "exit code": 0, "last": "", "placed": "6/6", "share placed": 1.0,
        "registered": 6, "misplaced": 0, "silent": 0,
        "AUC@5": 0.8, "known": "6/6", "focal %": 0.5, "wrong": 0, "known after": "6/6", "focal % after": 0.4,
        "wrong after": 0, "stated": 4, "beyond 3 sd": 0, "worst in sd": 1.0,
    }  # fmt: skip
    return fine | figures


def met(rows):
    return [demand["met"] for demand in trouble.demands(rows)]


def test_one_wrong_camera_in_a_hundred_folders_passes_and_two_do_not():
    fine = [folder_row(seed) for seed in range(98)]
    one, two = folder_row(98, wrong=1), folder_row(99, wrong=1, **{"wrong after": 1})
    assert met([*fine, one, folder_row(99)]) == ["yes"] * 5
    assert met([*fine, one, two]) == ["yes", "no", "yes", "yes", "yes"]
    assert trouble.demands([*fine, one, two])[1]["seeds"] == "98, 99"


@pytest.mark.parametrize(("code", "fails"), [(0, False), (4, False), (1, True), (5, True), (None, True)])
def test_only_a_scene_or_a_reason_why_there_is_none_is_expected(code, fails):
    rows = [folder_row(**{"exit code": code, "last": "error: unexpected ValueError: x"})]
    assert (met(rows)[0] == "no") is fails
    assert ("unexpected ValueError" in trouble.page(rows)) is fails


def test_photos_in_wrong_places_fail_only_without_a_warning(tmp_path, monkeypatch):
    poses = {name: np.column_stack([np.eye(3), [-3.0 * k, 0.0, 4.0]]) for k, name in enumerate("abc")}
    photos = {name: TruePhoto(K, pose, 640.0) for name, pose in poses.items()}
    truth = SimpleNamespace(centers={name: -pose[:, 3] for name, pose in poses.items()}, vertices=np.zeros((1, 3)))
    shifted = {**poses, "b": poses["b"] + [[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0]]}
    models = [Model(shifted, {}, 5, 9, 0.3)]
    camera = CameraModel("OPENCV", (600.0, 600.0, 320.0, 240.0, 0, 0, 0, 0), K, 640, 480, {"fx": 1.0})
    scene = Scene(tmp_path, {}, {}, {"one": camera}, 5, 9, 0.3, {"b.jpg": "one"})
    monkeypatch.setattr(trouble, "read_scene", lambda _: scene)
    for against, silent in ((5, 1), (50, 0)):
        counts = {"scene": {"counts": {"explained_matches": 95, "contradicted_matches": against}}}
        (tmp_path / "manifest.json").write_text(json.dumps({"stages": counts}))
        assert trouble.misplaced(tmp_path, models, photos, truth) == {"misplaced": 1, "silent": silent}
    rows = [folder_row(seed) for seed in range(99)]
    assert met([*rows, folder_row(99, misplaced=1, silent=1)]) == ["yes"] * 5
    assert met([*rows, folder_row(99, misplaced=2, silent=2)])[3] == "no"


def test_the_absence_of_a_hypothesis_is_counted_in_the_folders_where_it_was_tried():
    trial = {"name": "finer-features", "accepted": True, "seconds": 2.5}
    whole = folder_row(trials=[trial], registered=6)
    without = folder_row(method="sfm-app, without finer-features", registered=4, **{"AUC@5": 0.5})
    page = trouble.page([whole, folder_row(2), without])
    assert "| all | 2 |" in page  # without it, a folder is not counted twice
    [gain] = [line for line in page.split("\n") if line.startswith("| finer-features |")]
    assert [cell.strip() for cell in gain.split("|")[1:9]] == ["finer-features", "1", "1", "2.5", "1", "2", "0", "0.3"]
