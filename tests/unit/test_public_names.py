"""Names of the package, progress told to a function, and settings."""

import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

import sfm_app
from sfm_app.errors import ConfigError
from sfm_app.progress import CallbackProgress, Progress, Step, as_progress, track
from sfm_app.settings import QUALITY_PRESETS, Settings


def test_every_public_name_exists():
    names = {"reconstruct", "calibrate_photos", "estimate_fundamental", "calibrate_fundamentals", "Settings"}
    assert names | {"export_model"} <= set(sfm_app.__all__)
    assert "export_model" in sfm_app.__all__
    assert all(getattr(sfm_app, name) is not None for name in sfm_app.__all__)


def test_an_estimator_refuses_bad_input_clearly():
    with pytest.raises(ValueError, match="x2"):
        sfm_app.estimate_fundamental(np.zeros((9, 2)), np.full((9, 2), np.nan))
    with pytest.raises(sfm_app.ConfigError, match="no calibrator is named 'kruppa5'"):
        sfm_app.calibrate_fundamentals(np.eye(3)[None], (640, 480), method="kruppa5")


def test_a_method_that_does_not_exist_is_refused_before_any_work(tmp_path):
    settings = sfm_app.Settings.from_mapping({"depth": {"method": "guess"}})
    with pytest.raises(sfm_app.ConfigError, match="no depth method is named 'guess'"):
        sfm_app.reconstruct(tmp_path, tmp_path / "out", settings)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_import_leaves_out_what_an_estimator_does_not_need():
    heavy = {"cv2", "open3d", "pycolmap", "trimesh", "matplotlib", "PIL", "rich"}
    heavy |= {"scipy.optimize", "scipy.sparse", "scipy.spatial"}
    lists = "import sys, sfm_app; sfm_app.estimate_fundamental; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", lists], capture_output=True, text=True, check=True)
    assert "sfm_app.fundamental.estimate" in done.stdout.split()
    assert heavy.isdisjoint(done.stdout.split())


@pytest.mark.slow
def test_the_processes_of_colmap_do_not_load_the_estimators():
    heavy = {"numba", "sfm_app.api", "sfm_app.plugins", "sfm_app.fundamental"}
    lists = "import sys, sfm_app.colmap.tasks, sfm_app.colmap.features; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", lists], capture_output=True, text=True, check=True)
    assert "pycolmap" in done.stdout.split()
    assert heavy.isdisjoint(done.stdout.split())


def test_a_function_is_called_with_every_step():
    steps = []
    progress = as_progress(steps.append)
    progress.stage("scene", "as asked")
    for _ in track(progress, range(2), "mapping", 2):
        pass
    progress.say("7 photos")
    assert steps == [
        Step("scene", "as asked", 0, 0), Step("scene", "mapping", 0, 2), Step("scene", "mapping", 1, 2),
        Step("scene", "mapping", 2, 2), Step("scene", "7 photos", 0, 0),
    ]  # fmt: skip


def test_an_exception_of_the_function_ends_the_work():
    def stop(step):
        if step.done == 2:
            raise RuntimeError("enough")

    done = []
    with pytest.raises(RuntimeError, match="enough"):
        done += track(as_progress(stop), range(9), "mapping", 9)
    assert done == [0, 1]


def test_a_display_is_taken_as_it_is_and_nothing_is_silence():
    shown = CallbackProgress(print)
    assert as_progress(shown) is shown
    assert isinstance(as_progress(None), Progress)


def test_toml_round_trip(tmp_path):
    path = tmp_path / "run.toml"
    changed = Settings.from_mapping(
        {"seed": 7, "quality": "draft", "depth": {"neighbors": 9}, "photos": {"images": "Fotos 📷\x7f.txt"}}
    )
    path.write_text(changed.to_toml(), encoding="utf-8")
    assert Settings.from_toml(path) == changed
    assert changed != Settings()


def test_every_setting_has_help_in_the_toml():
    lines = Settings().to_toml().splitlines()
    for above, line in pairwise(lines):
        if "=" in line and not line.startswith("#"):
            assert above.startswith("# ") and len(above) > 10, line


@pytest.mark.parametrize(
    ("values", "says", "hint"),
    [
        ({"sede": 1}, "unknown setting 'sede'", "did you mean 'seed'?"),
        ({"epipolar": {"max_eror_px": 1}}, "unknown setting 'epipolar.max_eror_px'", "mean 'epipolar.max_error_px'?"),
        ({"epipolar": {"confidence": 1.5}}, "'epipolar.confidence'", "sfm-app config"),
        ({"epipolar": {"max_error_px": float("nan")}}, "'epipolar.max_error_px'", "sfm-app config"),
        ({"epipolar": {"refit": "none"}}, "'epipolar.refit'", "sfm-app config"),
        ({"depth": 3}, "'depth'", "sfm-app config"),
        ({"quality": "best"}, "'quality'", "sfm-app config"),
    ],
)
def test_wrong_values_are_refused(values, says, hint):
    with pytest.raises(ConfigError) as caught:
        Settings.from_mapping(values, where="run.toml")
    assert str(caught.value).startswith("run.toml: ")
    assert says in str(caught.value)
    assert hint in caught.value.hint


def test_all_problems_are_listed_at_once():
    with pytest.raises(ConfigError, match=r"unknown setting 'a'.*unknown setting 'b'"):
        Settings.from_mapping({"a": 1, "b": 2})


def test_presets_are_valid_and_explicit_values_win():
    for name in QUALITY_PRESETS:
        assert Settings.from_mapping({"quality": name}).quality == name
    assert Settings.from_mapping({"quality": "draft"}).depth.max_image_size_px == 640
    own = Settings.from_mapping({"quality": "draft", "depth": {"max_image_size_px": 700}})
    assert own.depth.max_image_size_px == 700
