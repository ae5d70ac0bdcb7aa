import pickle
from itertools import pairwise

import pytest

from sfm_app.errors import ConfigError
from sfm_app.settings import QUALITY_PRESETS, Settings


def test_toml_round_trip(tmp_path):
    path = tmp_path / "run.toml"
    changed = Settings.from_mapping({"seed": 7, "quality": "draft", "depth": {"neighbors": 9}})
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


def test_a_file_that_is_not_toml_is_named(tmp_path):
    path = tmp_path / "run.toml"
    path.write_bytes(b"\xff\xfe= [")

    with pytest.raises(ConfigError, match=r"run\.toml is not a TOML file"):
        Settings.from_toml(path)
    with pytest.raises(ConfigError, match="cannot read"):
        Settings.from_toml(tmp_path / "missing.toml")


def test_settings_are_frozen_and_pickle():
    settings = Settings(seed=3)

    assert pickle.loads(pickle.dumps(settings)) == settings  # noqa: S301
    with pytest.raises(ValueError, match="frozen"):
        settings.seed = 4
