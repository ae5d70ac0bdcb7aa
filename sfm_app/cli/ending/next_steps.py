"""What one can do next, in two or three lines at the end of a run, for a person at a terminal."""

import shlex
import sys
from pathlib import Path

from sfm_app.api import Run
from sfm_app.settings import Settings

LABEL = 12
"""Columns of the labels in `outcome`."""


def run_steps(run: Run, photos: Path, out: Path | None, settings: Settings, *, quiet: bool) -> list[str]:
    """Return commands that go on from a run; none where nobody reads them.

    Args:
        run: the finished run.
        photos, out: as they were named.
        settings: of the run.
        quiet: whether nothing but results is wanted.
    """
    if quiet or not sys.stdout.isatty():
        return []
    again = f"sfm-app run {shlex.quote(str(photos))}" + (f" -o {shlex.quote(str(out))}" if out is not None else "")
    if run.mesh_path is None:
        return _steps([(again, "goes on to the model")])
    steps = [(_view(run), "look at it, measure it")]
    if settings.quality != "high":
        steps.append((f"{again} --quality high", "finer; draft: quicker"))
    steps.append((f"sfm-app export {shlex.quote(str(run.out))} --format obj", "for other programs"))
    return _steps(steps)


def demo_steps(run: Run, scene: str, *, quiet: bool) -> list[str]:
    """Return commands that go on from a demo; none where nobody reads them.

    Args:
        run: of the demo.
        scene: its name.
        quiet: whether nothing but results is wanted.
    """
    if quiet or not sys.stdout.isatty():
        return []
    other = "statue" if scene != "statue" else "fisheye"
    return _steps([
        (_view(run), "look at it"),
        (f"sfm-app demo --scene {other}", "another scene"),
        ("sfm-app run PHOTOS", "photos of your own"),
    ])  # fmt: skip


def _view(run: Run) -> str:
    return f"sfm-app view {shlex.quote(str(run.out))}"


def _steps(steps: list[tuple[str, str]]) -> list[str]:
    """Return commands below each other, with what they are for behind them, or below where they are long."""
    width = max(len(command) for command, _ in steps)
    fits = LABEL + width + 2 + max(len(text) for _, text in steps) <= 80
    lines = [f"{command:{width}}  {text}" if fits else f"{command}\n{'':{LABEL + 2}}{text}" for command, text in steps]
    return "\n".join(f"{'' if number else 'next':{LABEL}}{line}" for number, line in enumerate(lines)).split("\n")
