"""Run one method on one photo set, and score it against the truth."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.cameras.methods import Method, run
from benchmarks.cameras.score import (
    TruePhoto,
    accuracy,
    errors_before_adjustment,
    hashes,
    read_models,
    stated_deviations,
    times,
    true_photos,
)
from benchmarks.cameras.worker import OURS
from benchmarks.common.photo_sets import PhotoSet, steps
from benchmarks.common.results import Row

OWN_CAMERA_SETS = ("reichstag10",)
"""Sets in which every photo has its own camera."""
FEW_PHOTOS = 6
"""Sets with fewer photos do not use all kernels."""


def warm_up(sets: Sequence[PhotoSet], these: Sequence[Method], out: Path) -> None:
    """Compile the kernels: one unmeasured run for each kind of set, on its smallest set with enough photos."""
    by_size = sorted(sets, key=lambda photos: (_photo_count(photos) < FEW_PHOTOS, _total_bytes(photos)), reverse=True)
    smallest = {photos.cameras: photos for photos in by_size}
    for photos in smallest.values():
        for method in these:
            if method.kind == OURS:
                run(method, photos, out)


def measure(photos: PhotoSet, truth_file: Path, method: Method, out: Path) -> Row:
    """Run one method once on one set, and score it."""
    said = run(method, photos, out)
    return score_run(said, photos, true_photos(truth_file, steps(photos.name.partition(" ")[2])), method, out)


def score_run(said: Row, photos: PhotoSet, truth: Mapping[str, TruePhoto], method: Method, out: Path) -> Row:
    """Score a finished run; true photos that the set does not have are left out."""
    truth = {name: true for name, true in truth.items() if (photos.folder / f"{name}.png").exists()}
    models = read_models(out)
    row = {"photos": photos.name, "method": method.name, "failed": said["failed"], "exit code": said["exit code"]}
    row |= accuracy(models, truth, _photo_count(photos)) | times(said["seconds"], complete=not said["failed"])
    row |= {name: said.get(name) for name in ("wall seconds", "CPU seconds", "peak MB")}
    if method.kind == OURS:
        row |= errors_before_adjustment(out, truth) | hashes(out)
        row |= stated_deviations(out, models[0], truth) if models else {}
    return row


def _photo_count(photos: PhotoSet) -> int:
    return len(list(photos.folder.glob("*.png")))


def _total_bytes(photos: PhotoSet) -> int:
    return sum(path.stat().st_size for path in photos.folder.glob("*.png"))
