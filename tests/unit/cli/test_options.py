"""Flags take type, help, range and default from their settings; a shell completes their values."""

import re

import click
import pytest
from click.shell_completion import ShellComplete

from sfm_app.cli import commands
from sfm_app.cli.commands import SCENES
from sfm_app.cli.options import (
    SETTING_FLAGS,
    default_text,
    help_text,
    range_text,
    setting_field,
    setting_value,
    settings_from_flags,
)
from sfm_app.cli.program import main
from sfm_app.frame.markers import FAMILIES, PAGES_MM
from sfm_app.pipeline import NAMES
from sfm_app.plugins import load_plugins
from sfm_app.settings import QUALITY_PRESETS, Settings

PARAMETERS = {parameter.name: parameter for parameter in commands.run.params}
VALUES = {"seed": 3, "workers": 2, "cluster": "local:2",
          "max_memory": 4.0, "quality": "draft", "images": "list.txt", "masks": "masks",
          "cameras": "single", "max_frames": 50, "keep_low_quality": True, "features": "sift-affine", "pairs": "all",
          "estimator": "msac", "calibrator": "kruppa", "calibration": "cameras.txt", "keep_calibration": True,
          "camera_model": "RADIAL", "mapper": "global", "scale": (("0,0,0", "1,0,0", "1.25m"),),
          "level": (("0,0,0", "1,0,0", "0,0,1"),), "markers": "50mm",
          "gcp": "gcp_list.txt", "positions": "geo.txt", "faces": 1000,
          "watertight": True, "unseen_faces": "cut"}  # fmt: skip
"""A value other than the default for every flag."""
every_flag = pytest.mark.parametrize("flag", SETTING_FLAGS, ids=lambda flag: flag.flag)


def flags(**values):
    """The parameters that click passes to a command."""
    return {**dict.fromkeys(VALUES), "verbose": 0, "no_plugins": False, "assignments": (), "config": None} | values


@pytest.fixture(scope="module")
def help_page():
    """The page of `run --help` in one line."""
    context = click.Context(commands.run, info_name="run", terminal_width=10_000, max_content_width=10_000)
    return re.sub(r"\s+", " ", commands.run.get_help(context))


@every_flag
def test_the_help_is_that_of_the_setting(flag, help_page):
    text = PARAMETERS[flag.parameter].help
    assert text.lower().startswith(f"{setting_field(flag.setting).description.lower()}.")
    assert default_text(flag.setting) in text and range_text(flag.setting) in text
    assert re.sub(r"\s+", " ", text) in help_page


@every_flag
def test_the_default_is_true_with_every_quality(flag):
    text = default_text(flag.setting)
    for quality in QUALITY_PRESETS:
        value = setting_value(Settings.from_mapping({"quality": quality}), flag.setting)
        if flag.setting != "quality" and value not in ("", ()) and not isinstance(value, bool):
            assert text == f"default: {value}" or f"{value} for {quality}" in text


def test_defaults_and_ranges_are_written_as_click_does():
    assert default_text("mesh.faces") == "default: 50000 for draft, 200000 for normal, 1000000 for high"
    assert range_text("photos.max_frames") == "2<=x<=2000" and range_text("epipolar.confidence") == "0<x<1"
    assert range_text("seed") == "0<=x<4294967296" and range_text("photos.images") == ""
    assert help_text("photos.max_frames").endswith(".  [default: 100; 2<=x<=2000]")


@every_flag
def test_a_flag_changes_its_setting_and_no_other(flag):
    value = VALUES[flag.parameter]
    changed = settings_from_flags(flags(**{flag.parameter: value}))
    assert setting_value(changed, flag.setting) == value != setting_value(Settings(), flag.setting)
    assert changed == Settings.from_mapping(flag.to_mapping(value))


def test_no_flag_changes_nothing():
    assert settings_from_flags(flags()) == Settings()
    assert not settings_from_flags(flags(no_plugins=True)).plugins


def test_run_has_every_flag():
    shared = set(PARAMETERS) - {"photos", "out", "first", "last", "as_json", "quiet", "no_picture"}
    assert shared == {flag.parameter for flag in SETTING_FLAGS} | {"config", "no_plugins", "assignments", "verbose"}


def test_choices_are_those_of_the_modules_that_the_help_does_not_import():
    assert tuple(commands.STAGES) == NAMES and sorted(commands.MARKER_FAMILIES) == sorted(FAMILIES)
    assert tuple(PAGES_MM) == commands.PAPERS


def completions(*words):
    """The completions of the last word."""
    completion = ShellComplete(main, {}, "sfm-app", "_SFM_APP_COMPLETE")
    return [item.value for item in completion.get_completions(list(words[:-1]), words[-1])]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("re",), ["report"]),
        (("run", "--from", ""), list(NAMES)),
        (("run", "--until", "s"), ["scene", "scale"]),
        (("run", "--quality", ""), list(QUALITY_PRESETS)),
        (("demo", "--scene", ""), list(SCENES)),
        (("run", "--mapper", "i"), ["incremental"]),
        (("completion", ""), list(commands.SHELLS)),
        (("run", "--no-pl"), ["--no-plugins"]),
    ],
)
def test_commands_choices_and_flags_are_completed(words, expected):
    assert completions(*words) == expected


@pytest.mark.parametrize(
    ("words", "kinds"),
    [
        (("run", "--estimator", ""), ["estimators"]),
        (("calibrate", "--calibrator", ""), ["calibrators"]),
        (("run", "--features", ""), ["features"]),
        (("export", "--format", ""), ["exporters", "scene_exporters"]),
    ],
)
def test_methods_and_formats_are_completed(words, kinds):
    maps = ["orthophoto", "dsm", "dtm", "contours"] if words[0] == "export" else []
    assert completions(*words) == [name for kind in kinds for name in getattr(load_plugins(), kind)] + maps
    assert completions(*words[:-1], "no-such") == []


def test_scripts_for_older_versions_still_run(tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["run", str(tmp_path / "none"), "-o", str(tmp_path / "out"), "--no-picture"])
    assert exit_.value.code == 3
    assert "not found" in capsys.readouterr().err
