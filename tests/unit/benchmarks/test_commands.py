"""Every benchmark is a command: `python -m benchmarks.SUBJECT`."""

import argparse
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import benchmarks
from benchmarks.common.command_line import add_pictures, add_rendered, add_seeds, ensure_single_thread, is_wanted
from benchmarks.common.processes import environment, module_command

PACKAGE = Path(benchmarks.__file__).parent
SHARED = (
    "benchmarks",
    "benchmarks.common",
    "benchmarks.surface.depth_camera",
    "benchmarks.surface.rendered",
    "benchmarks.thesis",
)
"""Packages that are no command."""
MOST_FILES = 15


def packages():
    """Every package by its dotted name, and its folder."""
    folders = sorted(path.parent for path in PACKAGE.rglob("__init__.py") if "node_modules" not in path.parts)
    return {".".join(folder.relative_to(PACKAGE.parent).parts): folder for folder in folders}


COMMANDS = [name for name in packages() if name not in SHARED]


def test_every_folder_is_a_command_or_shared():
    found = {name for name, folder in packages().items() if (folder / "__main__.py").exists()}

    assert found == set(COMMANDS)
    assert {path.parent for path in PACKAGE.rglob("*.py") if "node_modules" not in path.parts} == set(
        packages().values()
    )


@pytest.mark.parametrize("name", packages())
def test_no_folder_is_crowded(name):
    assert len([path for path in packages()[name].iterdir() if path.is_file()]) <= MOST_FILES


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_shows_the_command(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["__main__.py", "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(name, run_name="__main__")

    shown = capsys.readouterr().out
    assert ended.value.code == 0
    assert shown.startswith(f"usage: python -m {name} ")
    assert re.search(rf"^ *python -m {name} ", shown, re.MULTILINE), "its docstring shows how it is called"


@pytest.mark.parametrize("worker", ["benchmarks.cameras.worker", "benchmarks.surface.worker"])
def test_a_worker_is_found_from_anywhere_and_brings_nothing_but_itself(worker, tmp_path):
    code = f"import sys, {worker}; print({{'numpy', 'sfm_app', 'pycolmap'}} & set(sys.modules))"
    command = [*module_command(worker)[:-2], "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False)

    assert done.stdout.strip() == "set()", done.stderr


def test_shared_options_keep_the_defaults_of_their_command():
    rendered, drawn = argparse.ArgumentParser(), argparse.ArgumentParser()
    add_rendered(rendered, ["statue", "facade"])
    add_seeds(drawn, 5, "lens-models")

    every, one = (rendered.parse_args(["--cache", "c", *line]) for line in ([], ["--scenes", "facade", "--ours-only"]))
    few = drawn.parse_args(["--first-seed", "7"])

    assert (every.cache, every.scenes, every.seed, every.ours_only) == (Path("c"), ["statue", "facade"], 0, False)
    assert (one.scenes, one.ours_only) == (["facade"], True)
    assert (few.seeds, few.first_seed, few.name) == (5, 7, "lens-models")
    assert every.results == few.results == PACKAGE / "results"
    with pytest.raises(SystemExit):
        rendered.parse_args(["--cache", "c", "--scenes", "corner"])


def test_pictures_are_drawn_where_they_are_asked_for():
    parser = argparse.ArgumentParser()
    add_pictures(parser, "sets")
    none, every, one = (parser.parse_args(line).pictures for line in ([], ["--pictures"], ["--pictures", "statue"]))

    assert [is_wanted(asked, "statue") for asked in (none, every, one)] == [False, True, True]
    assert not is_wanted(one, "corner")


def test_a_command_starts_anew_as_it_was_called(monkeypatch):
    calls = []
    monkeypatch.setattr("os.execve", lambda *given: calls.append(given))
    monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "dev", "-m", "benchmarks.fundamental", "--seed", "1"])
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    ensure_single_thread()

    ((path, command, given),) = calls
    assert path == sys.executable == command[0]
    assert command[1:] == ["-X", "dev", "-m", "benchmarks.fundamental", "--seed", "1"]
    assert given["OMP_NUM_THREADS"] == given["NUMBA_NUM_THREADS"] == "1"
