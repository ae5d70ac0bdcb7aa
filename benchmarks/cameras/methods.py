"""The methods that turn photos into cameras; each runs in a process of its own, see worker.py."""

import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.cameras.worker import GLOBAL, INCREMENTAL, OPENMVG, OURS, RESULT
from benchmarks.common.photo_sets import PhotoSet, link_or_copy
from benchmarks.common.processes import module_command, run_command
from benchmarks.common.results import Row
from sfm_app.settings import MatchSettings, merge_nested

STOCK = (INCREMENTAL, GLOBAL)
WORKER = "benchmarks.cameras.worker"


@dataclass(frozen=True, slots=True)
class Method:
    """A method that turns photos into cameras."""

    name: str
    kind: str = OURS
    """`OURS`, `OPENMVG`, or one of `STOCK`."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the program that differ from its defaults; what another one is told of the camera."""
    without: str = ""
    """Hypothesis about the photos that is switched off; such a run resumes a finished one at its scene."""


def is_stock(name: str) -> bool:
    """Return whether a method of this name is stock pycolmap, told of a camera or not."""
    return name.partition(",")[0] in STOCK


def methods(also: Mapping[str, Mapping[str, Any]], *, ours_only: bool = False) -> list[Method]:
    """List the program with its defaults, the program with other settings, and pycolmap's two mappers."""
    ours = [Method(OURS), *(Method(f"{OURS}, {label}", OURS, settings) for label, settings in also.items())]
    return ours if ours_only else ours + [Method(kind, kind) for kind in STOCK]


def ablations(names: Sequence[str]) -> list[Method]:
    """List the program without each hypothesis."""
    return [Method(f"{OURS}, without {name}", OURS, {"scene": {"without": [name]}}, name) for name in names]


def told_methods(K: NDArray[np.float64], size: tuple[int, int], errors: Sequence[float]) -> list[Method]:
    """List stock incremental with a focal that is off by each error in percent; for 0, with the true K, and kept.

    A network states a focal. The center stays in the middle, as in COLMAP.
    """
    focal, stated = float(K[0, 0] * K[1, 1]) ** 0.5, []
    for error in errors:
        if error:
            name, model = f"focal {error:g} % off", "SIMPLE_RADIAL"
            params = [(1 + error / 100) * focal, size[0] / 2, size[1] / 2, 0.0]
        else:
            name, model, params = "true K", "PINHOLE", [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        text = ",".join(str(float(value)) for value in params)
        told = {"camera_model": model, "camera_params": text, "keep_camera": not error}
        stated.append(Method(f"{INCREMENTAL}, told: {name}", INCREMENTAL, told))
    return stated


def openmvg_methods(K: NDArray[np.float64]) -> list[Method]:
    """List openmvg-rs without and with the true K, whose first pixel has its center at (0, 0) there."""
    told = K - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    return [Method(OPENMVG, OPENMVG), Method(f"{OPENMVG}, told: true K", OPENMVG, {"K": told.tolist()})]


def rotate_methods(these: Sequence[Method], repetition: int) -> list[Method]:
    """Start every repetition with another method, so that none always meets a cold or a busy machine."""
    first = repetition % len(these)
    return [*these[first:], *these[:first]]


def run(method: Method, photos: PhotoSet, out: Path, limit_s: float | None = None, finished: Path | None = None) -> Row:
    """Run a method into OUT, and return its times, its peak memory and the reason if it failed.

    It starts from scratch, or from a copy of a finished run with other settings. After `limit_s` the process is killed,
    together with its children.
    """
    shutil.rmtree(out, ignore_errors=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    if finished is not None:
        shutil.copytree(finished, out, symlinks=True)
    ours = method.settings if method.kind == OURS else {}
    usual = {"report": False, "photos": {"cameras": photos.cameras if photos.cameras_given else "auto"}}
    settings = merge_nested(usual, ours)  # no rival writes a report
    cap = MatchSettings(**settings.get("matching", {})).max_image_size_px
    options = {"settings": settings, "cameras": photos.cameras, "max_image_size_px": cap}
    if method.kind != OURS:
        options |= method.settings
    folder = photos.folder
    if method.kind in STOCK and photos.cameras != "each" and len(sizes := group_by_size(folder)) > 1:
        folder, options["cameras"] = split_into_folders(sizes, folder.with_name(f"{folder.name}-by-size")), "folder"
    command = module_command(WORKER, method.kind, str(folder), str(out), json.dumps(options))
    start = time.perf_counter()
    code, last = run_command(command, limit_s)
    said: Row = {"wall seconds": round(time.perf_counter() - start, 2)}
    if (out / RESULT).exists():
        found: Row = json.loads((out / RESULT).read_text(encoding="utf-8"))
        return said | found
    failed = f"not finished after {limit_s:g} s" if code is None else f"exit code {code}: {last}"
    return said | {"failed": failed, "exit code": code, "seconds": {}, "peak MB": None}


def group_by_size(folder: Path) -> dict[tuple[int, int], list[Path]]:
    """Group the photos of a folder by width and height."""
    found: dict[tuple[int, int], list[Path]] = {}
    for path in sorted(folder.glob("*.png")):
        with Image.open(path) as image:
            found.setdefault(image.size, []).append(path)
    return found


def split_into_folders(sizes: Mapping[tuple[int, int], Sequence[Path]], into: Path) -> Path:
    """Make a folder for each size: told of one camera for all, COLMAP leaves out photos that lie on their side."""
    for (width, height), photos in sizes.items():
        folder = into / f"{width}x{height}"
        folder.mkdir(parents=True, exist_ok=True)
        for photo in photos:
            link_or_copy(photo, folder)
    return into
