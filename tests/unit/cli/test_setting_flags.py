"""Flags say of settings what the settings say of themselves."""

import re

import click
import pytest

from sfm_app.cli import main
from sfm_app.cli.options import settings_from_flags
from sfm_app.cli.setting_flags import SETTING_FLAGS, default_text, help_text, range_text, setting_field, setting_value
from sfm_app.errors import ConfigError
from sfm_app.settings import QUALITY_PRESETS, Settings

RUN = main.commands["run"]
PARAMETERS = {parameter.name: parameter for parameter in RUN.params}
GIVEN = {"seed": 3, "workers": 2, "cluster": "local:2",
         "max_memory": 4.0, "quality": "draft", "images": "list.txt", "masks": "masks",
         "cameras": "single", "max_frames": 50, "keep_low_quality": True, "features": "sift-dsp", "pairs": "all",
         "estimator": "msac", "calibrator": "kruppa", "calibration": "cameras.txt", "keep_calibration": True,
         "camera_model": "RADIAL", "mapper": "global", "scale": (("0,0,0", "1,0,0", "1.25m"),), "markers": "50mm",
         "gcp": "gcp_list.txt", "faces": 1000, "unseen_faces": "cut"}  # fmt: skip
"""A value for every flag that is not the default."""


def flags(**given):
    """What click hands to a command."""
    return {**dict.fromkeys(GIVEN), "verbose": 0, "no_plugins": False, "assignments": (), "config": None} | given


@pytest.fixture(scope="module")
def printed():
    """The page of --help in one line."""
    text = RUN.get_help(click.Context(RUN, info_name="run", terminal_width=10_000, max_content_width=10_000))
    return re.sub(r"\s+", " ", text)


@pytest.mark.parametrize("flag", SETTING_FLAGS, ids=lambda flag: flag.flag)
def test_the_help_is_that_of_the_setting(flag, printed):
    description = setting_field(flag.setting).description
    said = PARAMETERS[flag.parameter].help

    assert said.lower().startswith(f"{description.lower()}.")
    assert default_text(flag.setting) in said
    assert range_text(flag.setting) in said
    assert re.sub(r"\s+", " ", said) in printed


@pytest.mark.parametrize("flag", SETTING_FLAGS, ids=lambda flag: flag.flag)
def test_the_default_is_true_with_every_quality(flag):
    text = default_text(flag.setting)
    for quality in QUALITY_PRESETS:
        value = setting_value(Settings.from_mapping({"quality": quality}), flag.setting)
        if flag.setting != "quality" and value not in ("", ()) and not isinstance(value, bool):
            assert text == f"default: {value}" or f"{value} for {quality}" in text


def test_faces_depend_on_the_quality():
    assert default_text("mesh.faces") == "default: 50000 for draft, 200000 for normal, 1000000 for high"


def test_ranges_are_written_as_click_does():
    assert range_text("photos.max_frames") == "2<=x<=2000"
    assert range_text("epipolar.confidence") == "0<x<1"
    assert range_text("seed") == "0<=x<4294967296"
    assert range_text("photos.images") == ""
    assert help_text("photos.max_frames").endswith(".  [default: 100; 2<=x<=2000]")


@pytest.mark.parametrize("flag", SETTING_FLAGS, ids=lambda flag: flag.flag)
def test_a_flag_changes_its_setting_and_no_other(flag):
    changed = settings_from_flags(flags(**{flag.parameter: GIVEN[flag.parameter]}))

    assert setting_value(changed, flag.setting) == GIVEN[flag.parameter] != setting_value(Settings(), flag.setting)
    assert changed == Settings.from_mapping(flag.to_mapping(GIVEN[flag.parameter]))


def test_no_flag_changes_nothing():
    assert settings_from_flags(flags()) == Settings()
    assert not settings_from_flags(flags(no_plugins=True)).plugins


def test_every_flag_of_a_command_that_takes_settings_is_known():
    shared = set(PARAMETERS) - {"photos", "out", "first", "last", "as_json", "quiet"}
    assert shared == {flag.parameter for flag in SETTING_FLAGS} | {"config", "no_plugins", "assignments", "verbose"}


def test_values_out_of_range_are_refused_by_the_settings():
    with pytest.raises(ConfigError, match=r"'photos\.max_frames'"):
        settings_from_flags(flags(max_frames=1))
