"""Photos to cameras by one method in a process of its own: by the program, or by pycolmap as it comes.

Run as a script it is that process: ``cameras_methods.py METHOD PHOTOS OUT JSON``.
"""

import json
import re
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from photo_sets import PhotoSet
from report import Row

OURS = "sfm-app"
INCREMENTAL, GLOBAL = "incremental", "global"
STOCK = (INCREMENTAL, GLOBAL)
RESULT = "benchmark.json"
"""In OUT: what the process says about itself."""


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
    options = {"cameras": photos.cameras, "settings": method.settings}
    command = [sys.executable, __file__, method.kind, str(photos.folder), str(out), json.dumps(options)]
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = {"wall seconds": round(time.perf_counter() - start, 2)}
    if (out / RESULT).exists():
        return said | json.loads((out / RESULT).read_text(encoding="utf-8"))
    last = done.stderr.strip().splitlines()[-1:] or ["no word"]
    return said | {"failed": f"exit code {done.returncode}: {last[0]}", "seconds": {}}


def ours(photos: Path, out: Path, options: Mapping[str, Any]) -> Row:
    """The program until the cameras stand; its seconds are those of the manifest."""
    import sfm_app
    from sfm_app.settings import merged

    settings = sfm_app.Settings.from_mapping(merged({"photos": {"cameras": options["cameras"]}}, options["settings"]))
    failed, manifest = "", out / "manifest.json"
    try:
        sfm_app.reconstruct(photos, out, settings, last="scene")
    except sfm_app.SfmError as error:
        failed = str(error)
    stages = json.loads(manifest.read_text(encoding="utf-8"))["stages"] if manifest.exists() else {}
    return {"failed": failed, "seconds": {name: stage["seconds"] for name, stage in stages.items()}}


def stock(photos: Path, out: Path, options: Mapping[str, Any], mapper: str) -> Row:
    """pycolmap's defaults but for a seed, the program's cap on the image size, and one camera where there is one."""
    from sfm_app.colmap.backend import pycolmap
    from sfm_app.settings import MatchSettings

    out.mkdir()
    pycolmap.set_random_seed(0)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = MatchSettings().max_image_size_px
    mode = pycolmap.CameraMode.AUTO if options["cameras"] == "each" else pycolmap.CameraMode.SINGLE
    database, sparse = out / "database.db", out / "sparse"
    steps = {
        "features": lambda: pycolmap.extract_features(
            database, photos, camera_mode=mode, extraction_options=extraction
        ),
        "match_and_verify": lambda: pycolmap.match_exhaustive(database),
    }
    if mapper == GLOBAL:
        steps["calibrate"] = lambda: pycolmap.calibrate_view_graph(database)
        steps["map"] = lambda: pycolmap.global_mapping(database, photos, sparse)
    else:
        steps["map"] = lambda: pycolmap.incremental_mapping(database, photos, sparse)
    seconds = {}
    for name, step in steps.items():
        start = time.perf_counter()
        step()
        seconds[name] = round(time.perf_counter() - start, 2)
    return {"failed": "", "seconds": seconds}


def peak_mb() -> int:
    """Most memory that this process has held; the kernel's other count starts with what the parent held."""
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text()) if status.exists() else None
    return (int(found[1]) if found else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) // 1024


def main() -> None:
    kind, photos, out, text = sys.argv[1:]
    options = json.loads(text)
    found = ours(Path(photos), Path(out), options) if kind == OURS else stock(Path(photos), Path(out), options, kind)
    (Path(out) / RESULT).write_text(json.dumps(found | {"peak MB": peak_mb()}), encoding="utf-8")


if __name__ == "__main__":
    main()
