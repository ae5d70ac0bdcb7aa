"""The ways from photos to cameras, and how one of them is run: in a process of its own, see cameras_run.py."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cameras_run
from cameras_run import GLOBAL, INCREMENTAL, OURS, RESULT
from photo_sets import PhotoSet
from report import Row

from sfm_app.settings import MatchSettings, merged

STOCK = (INCREMENTAL, GLOBAL)


@dataclass(frozen=True, slots=True)
class Method:
    """One way from photos to cameras."""

    name: str
    kind: str = OURS
    """`OURS`, or one of `STOCK`."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Of the program, beside its defaults."""


def methods(also: Mapping[str, Mapping[str, Any]], *, ours_only: bool = False) -> list[Method]:
    """The program as it comes and under other settings, and pycolmap's two ways of mapping."""
    ours = [Method(OURS), *(Method(f"{OURS}, {label}", OURS, settings) for label, settings in also.items())]
    return ours if ours_only else ours + [Method(kind, kind) for kind in STOCK]


def taking_turns(these: Sequence[Method], repetition: int) -> list[Method]:
    """Every repetition starts with another method, so that none always meets a cold or a busy machine."""
    first = repetition % len(these)
    return [*these[first:], *these[:first]]


def run(method: Method, photos: PhotoSet, out: Path) -> Row:
    """Run a method from nothing into OUT; seconds of its steps, peak memory, and why it failed where it did."""
    shutil.rmtree(out, ignore_errors=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    settings = merged({"photos": {"cameras": photos.cameras if photos.told else "auto"}}, method.settings)
    cap = MatchSettings(**settings.get("matching", {})).max_image_size_px
    options = {"settings": settings, "cameras": photos.cameras, "max_image_size_px": cap}
    command = [sys.executable, cameras_run.__file__, method.kind, str(photos.folder), str(out), json.dumps(options)]
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = {"wall seconds": round(time.perf_counter() - start, 2)}
    if (out / RESULT).exists():
        return said | json.loads((out / RESULT).read_text(encoding="utf-8"))
    last = done.stderr.strip().splitlines()[-1:] or ["no word"]
    return said | {"failed": f"exit code {done.returncode}: {last[0]}", "seconds": {}, "peak MB": None}
