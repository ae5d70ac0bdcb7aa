"""What one can do next is said to a person at a terminal, and to nobody else."""

import io
from pathlib import Path
from types import SimpleNamespace

import pytest

from sfm_app.api import Run
from sfm_app.cli import main
from sfm_app.cli.ending import next_steps
from sfm_app.cli.ending.next_steps import demo_steps, run_steps
from sfm_app.settings import Settings

PHOTOS, OUT = Path("my photos"), Path("out")


@pytest.fixture
def screen(monkeypatch):
    place = io.StringIO()
    place.isatty = lambda: True
    monkeypatch.setattr(next_steps, "sys", SimpleNamespace(stdout=place))


@pytest.fixture
def run(tmp_path):
    return Run(OUT, None, None, None, OUT / "model.glb", {})


def test_commands_that_go_on_are_named_as_they_are_typed(screen, run):
    assert run_steps(run, PHOTOS, None, Settings(), quiet=True) == []
    lines = run_steps(run, PHOTOS, None, Settings(), quiet=False)

    assert lines[0].startswith("next        sfm-app view out")
    assert lines[1].startswith("            sfm-app run 'my photos' --quality high")
    assert lines[2].startswith("            sfm-app export out --format obj")
    assert len(lines) == 3 and max(map(len, lines)) <= 80
    assert len({line.rindex("  ") for line in lines}) == 1
    named = run_steps(run, PHOTOS, OUT, Settings(), quiet=False)
    assert "sfm-app run 'my photos' -o out --quality high" in "\n".join(named)


def test_long_commands_have_their_meaning_below(screen, run):
    lines = run_steps(run, Path("a" * 60), None, Settings(), quiet=False)

    assert len(lines) == 6 and all(line.startswith("              ") for line in lines[1::2])


def test_what_is_done_is_not_advised(screen, run):
    best = Settings.from_mapping({"quality": "high", "scale": {"markers": "50mm"}})
    assert not any("finer" in line for line in run_steps(run, PHOTOS, None, best, quiet=False))
    stopped = Run(OUT, None, None, None, None, {})
    assert ["goes on to the model" in line for line in run_steps(stopped, PHOTOS, None, best, quiet=False)] == [True]


@pytest.mark.parametrize(("scene", "other"), [("courtyard", "statue"), ("statue", "fisheye")])
def test_after_a_demo_come_another_one_and_own_photos(screen, run, scene, other):
    lines = demo_steps(run, scene, quiet=False)

    assert "sfm-app view out" in lines[0] and f"sfm-app demo --scene {other}" in lines[1]
    assert "sfm-app run PHOTOS" in lines[2] and max(map(len, lines)) <= 80
    assert demo_steps(run, scene, quiet=True) == []


def test_nobody_reads_it_in_a_pipe(monkeypatch, run):
    monkeypatch.setattr(next_steps, "sys", SimpleNamespace(stdout=io.StringIO()))

    assert run_steps(run, PHOTOS, None, Settings(), quiet=False) == demo_steps(run, "town", quiet=False) == []


def test_the_flags_that_are_named_are_there():
    known = {flag for parameter in main.commands["run"].params for flag in parameter.opts}
    assert {"--quality", "--markers", "-o"} <= known
