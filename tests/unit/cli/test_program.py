"""The program starts quickly, says what one can do, and completes names in a shell."""

import os
import subprocess
import sys

import click
import pytest
from click.shell_completion import BashComplete, ShellComplete
from click.testing import CliRunner

from sfm_app.cli import main
from sfm_app.cli.commands.machine import SHELLS
from sfm_app.cli.completions import BUILT_IN, names_of
from sfm_app.cli.program import SECTIONS
from sfm_app.demo import SCENES
from sfm_app.pipeline import NAMES
from sfm_app.plugins import load_plugins
from sfm_app.settings import QUALITY_PRESETS

HEAVY = ("numba", "scipy", "cv2", "pycolmap", "open3d", "trimesh", "matplotlib", "PIL", "rich", "sfm_app.api")
"""What takes most of the second and a half that all of the program needs to be imported."""
ENTRIES = {name: entry for section in SECTIONS.values() for name, entry in section.items()}


def loaded_by(*arguments, **environment):
    """Which of `HEAVY` a process has imported that was called so, and its stdout."""
    code = (
        "import sys; from sfm_app.cli import main\n"
        "try: main(prog_name='sfm-app')\n"
        f"finally: print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **environment},
    )
    return done.stderr.strip().splitlines()[-1], done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((), "sfm-app run PHOTOS"),
        (("--help",), "Use a finished run:"),
        (("--version",), "sfm-app, version "),
        (("completion", "zsh"), "#compdef sfm-app"),
        (("run", "--help"), "--quality"),
        (("demo", "--help"), "--scene"),
        (("config",), "[matching]"),
    ],
)
def test_what_needs_no_photos_imports_little(arguments, says):
    loaded, printed = loaded_by(*arguments)

    assert loaded == ("['pycolmap']" if arguments == ("config",) else "[]")
    assert says in printed


@pytest.mark.slow
@pytest.mark.parametrize(("typed", "offered"), [("sfm-app me", "measure"), ("sfm-app run --from int", "intrinsics")])
def test_completion_imports_little(typed, offered):
    count = str(len(typed.split()) - 1)
    loaded, printed = loaded_by(_SFM_APP_COMPLETE="bash_complete", COMP_WORDS=typed, COMP_CWORD=count)

    assert (loaded, printed.split()) == ("[]", [f"plain,{offered}"])


def test_without_arguments_it_says_what_one_can_do():
    found = CliRunner().invoke(main, [])

    lines = found.stdout.splitlines()
    assert found.exit_code == 0 and found.stderr == ""
    assert len(lines) <= 12 and max(map(len, lines)) <= 80
    assert [line.split()[1] for line in lines if line.startswith("  sfm-app")] == ["run", "demo", "doctor"]


def test_an_unknown_command_is_refused():
    found = CliRunner().invoke(main, ["ran"])

    assert found.exit_code == 2 and "No such command 'ran'" in found.stderr


@pytest.mark.parametrize("name", ENTRIES)
def test_every_entry_is_a_command_of_that_name(name):
    command = main.commands[name]

    assert isinstance(command, click.Command) and command.name == name
    assert command.callback.__module__ == ENTRIES[name].module
    assert 15 < len(ENTRIES[name].summary) <= 62 and ENTRIES[name].summary.endswith(".")


def test_help_has_every_command():
    printed = CliRunner().invoke(main, ["--help"]).stdout
    listed = [line.split()[0] for line in printed.split("Make a model:")[1].splitlines() if line.startswith("  ")]

    assert listed == list(main.commands) == list(ENTRIES)


def test_commands_can_be_added_and_removed():
    @click.command()
    def extra():
        """Do more."""

    main.add_command(extra)
    try:
        assert "Do more." in CliRunner().invoke(main, ["--help"]).stdout or "extra" in main.commands
    finally:
        del main.commands["extra"]
    assert "extra" not in main.commands and len(main.commands) == len(ENTRIES)


def offered(*typed):
    """What is completed after these words."""
    completion = ShellComplete(main, {}, "sfm-app", "_SFM_APP_COMPLETE")
    return [item.value for item in completion.get_completions(list(typed[:-1]), typed[-1])]


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        (("re",), ["report"]),
        (("run", "--from", ""), list(NAMES)),
        (("run", "--until", "s"), ["scene", "scale"]),
        (("run", "--quality", ""), list(QUALITY_PRESETS)),
        (("demo", "--scene", ""), list(SCENES)),
        (("run", "--mapper", "i"), ["incremental"]),
        (("completion", ""), list(SHELLS)),
        (("run", "--no-pl"), ["--no-plugins"]),
    ],
)
def test_names_are_completed(typed, expected):
    assert offered(*typed) == expected


@pytest.mark.parametrize(
    ("typed", "kinds"),
    [
        (("run", "--estimator", ""), ["estimators"]),
        (("calibrate", "--calibrator", ""), ["calibrators"]),
        (("run", "--features", ""), ["features"]),
        (("export", "--format", ""), ["exporters", "scene_exporters"]),
    ],
)
@pytest.mark.parametrize("installed", [True, False])
def test_methods_and_formats_are_completed_those_of_plugins_included(monkeypatch, typed, kinds, installed):
    monkeypatch.setattr("sfm_app.cli.completions.entry_points", lambda **_: ["one"] if installed else [])
    known = load_plugins(installed=installed)

    assert offered(*typed) == [name for kind in kinds for name in getattr(known, kind)]
    assert offered(*typed[:-1], "no-such") == []


@pytest.mark.parametrize("kind", BUILT_IN)
def test_the_names_at_hand_are_those_of_the_methods(monkeypatch, kind):
    monkeypatch.setattr("sfm_app.cli.completions.entry_points", lambda **_: [])

    assert names_of(kind) == tuple(getattr(load_plugins(installed=False), kind))


@pytest.mark.parametrize("shell", SHELLS)
def test_a_script_for_each_shell_calls_the_program(monkeypatch, shell):
    monkeypatch.setattr(BashComplete, "_check_version", lambda *_: None)  # starts bash
    found = CliRunner().invoke(main, ["completion", shell])

    assert found.exit_code == 0 and f"_SFM_APP_COMPLETE={shell}_complete" in found.stdout
    assert "sfm-app" in found.stdout


def test_no_script_for_another_shell():
    assert CliRunner().invoke(main, ["completion", "tcsh"]).exit_code == 2
