"""Finished runs in the cache, and whether they can be reused."""

import argparse
import hashlib
import json
from pathlib import Path
from typing import NamedTuple

import sfm_app
from benchmarks.cameras import worker
from benchmarks.cameras.methods import Method, run
from benchmarks.cameras.worker import OURS
from benchmarks.common.photo_sets import PhotoSet
from benchmarks.common.results import Row
from sfm_app.engine.stage import versions

RECORD = "corpus.json"
"""File in OUT with the key of a run and its result."""


class FinishedRun(NamedTuple):
    """A finished run."""

    key: str
    """Hash of the program, settings and photos of the run."""
    said: Row


def run_key(method: Method, photos: PhotoSet) -> str:
    """Hash everything that a run depends on; a stock run does not depend on our program."""
    package = Path(sfm_app.__file__).parent
    sources = sorted(package.rglob("*.py")) if method.kind == OURS else [Path(worker.__file__)]
    found = hashlib.sha256(json.dumps([method.kind, method.settings, photos.cameras, versions()]).encode())
    for path in [*sources, *sorted(photos.folder.glob("*.*g"))]:
        content = path.read_bytes() if path.suffix == ".py" else str(path.stat().st_size).encode()
        found.update(path.name.encode() + b"\0" + content)
    return found.hexdigest()[:16]


def load_finished_run(out: Path) -> FinishedRun | None:
    """Read the run in OUT, if it finished."""
    try:
        return FinishedRun(**json.loads((out / RECORD).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def reusable_run(method: Method, photos: PhotoSet, out: Path, args: argparse.Namespace) -> FinishedRun | None:
    """Return the run in OUT if it can be reused. A run that timed out is repeated when it gets more time."""
    before = load_finished_run(out)
    if before is None or args.score_only:
        return before
    cut_short = before.said["exit code"] is None and before.said["wall seconds"] < 60 * args.limit_min
    return before if args.keep and before.key == run_key(method, photos) and not cut_short else None


def run_and_record(
    method: Method, photos: PhotoSet, out: Path, limit_s: float, finished: Path | None = None
) -> FinishedRun:
    """Run a method, from a copy of a finished run if there is one, and record its result."""
    done = FinishedRun(run_key(method, photos), run(method, photos, out, limit_s, finished))
    record_run(out, done)
    return done


def trials(out: Path) -> list[Row]:
    """Return the hypotheses that the run in OUT tried; none if it has no scene."""
    listed: list[Row] = _scene_counts(out).get("hypotheses", [])
    return listed


def has_tried(out: Path, hypothesis: str) -> bool:
    """Return whether the run in OUT tried a hypothesis, by itself or within another one."""
    counts = _scene_counts(out)
    named = {part for trial in trials(out) for part in trial["name"].split(": ")}
    entries = {"look-alikes": "look_alikes", "lens-families": "lenses", "rolling-shutter": "shutter"}
    return hypothesis in named or bool(counts.get(entries.get(hypothesis, "")))


def _scene_counts(out: Path) -> Row:
    try:
        stages = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]
    except (OSError, ValueError, KeyError):
        return {}
    counts: Row = stages.get("scene", {}).get("counts", {})
    return counts


def record_run(out: Path, done: FinishedRun) -> None:
    """Record in OUT that a run finished, and its result."""
    out.mkdir(parents=True, exist_ok=True)
    (out / RECORD).write_text(json.dumps(done._asdict()), encoding="utf-8")
