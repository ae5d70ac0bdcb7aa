"""Turn photos into cameras by one method: ``python -m benchmarks.cameras.worker METHOD PHOTOS OUT JSON``.

Each run is a process of its own and imports only what the method needs, so that memory and times are the method's.
"""

import json
import sys
import time
import zlib  # before pycolmap, see docs/libraries/pycolmap.md
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.common.memory import cpu_seconds, peak_mb

OURS = "sfm-app"
INCREMENTAL, GLOBAL, OPENMVG = "incremental", "global", "openmvg-rs"
RESULT = "benchmark.json"
"""File in OUT with the process's own report."""
MODES = {"each": "AUTO", "folder": "PER_FOLDER"}
"""pycolmap's camera mode by our name for it; anything else means one camera for all photos."""


def run_ours(photos: Path, out: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Run the program up to its scene; the seconds are those of its manifest."""
    import sfm_app

    failed, code, run, manifest = "", 0, None, out / "manifest.json"
    try:
        run = sfm_app.reconstruct(photos, out, sfm_app.Settings.from_mapping(options["settings"]), last="scene")
    except sfm_app.SfmError as error:
        failed, code = str(error), error.exit_code
    except Exception as error:  # as in the commands; log.txt has the traceback
        failed, code = f"unexpected {type(error).__name__}: {error}", 1
    stages = json.loads(manifest.read_text(encoding="utf-8"))["stages"] if manifest.exists() else {}
    said = {"failed": failed, "exit code": code, "peak MB": peak_mb()}
    if run is not None:
        from sfm_app.cli.outcome import run_lines  # imported late: its cost is not the method's

        said["summary"] = list(run_lines(run))
    return said | {"seconds": {name: stage["seconds"] for name, stage in stages.items()}}


def run_stock(photos: Path, out: Path, options: Mapping[str, Any], mapper: str) -> dict[str, Any]:
    """Run pycolmap with its defaults but for a seed, a cap on the image size, and cameras shared as the options say."""
    import pycolmap

    zlib.crc32(b"")  # keeps the import above, which is there for its side effect
    out.mkdir()
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(0)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = options["max_image_size_px"]
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = options.get("camera_model") or reader.camera_model
    reader.camera_params = options.get("camera_params") or reader.camera_params
    mode = getattr(pycolmap.CameraMode, MODES.get(options["cameras"], "SINGLE"))
    database, sparse, seconds = out / "database.db", out / "sparse", {}
    start = time.perf_counter()

    def lap(step: str) -> None:
        nonlocal start
        seconds[step], start = round(time.perf_counter() - start, 2), time.perf_counter()

    pycolmap.extract_features(database, photos, camera_mode=mode, reader_options=reader, extraction_options=extraction)
    lap("features")
    pycolmap.match_exhaustive(database)
    lap("match_and_verify")
    if mapper == GLOBAL:
        pycolmap.calibrate_view_graph(database)
        lap("calibrate")
        pycolmap.global_mapping(database, photos, sparse)
    else:
        incremental = pycolmap.IncrementalPipelineOptions()
        if options.get("keep_camera"):
            incremental.ba_refine_focal_length = incremental.ba_refine_extra_params = False
        pycolmap.incremental_mapping(database, photos, sparse, incremental)
    lap("map")
    return {"failed": "", "exit code": 0, "seconds": seconds, "peak MB": peak_mb()}


def run_openmvg(photos: Path, out: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Run openmvg-rs with its defaults; it guesses the camera where the options have no K."""
    from benchmarks.common.command_line import import_rival

    openmvg, file, start = import_rival("openmvg_rs"), None, time.perf_counter()
    out.mkdir()
    if "K" in options:
        file = out / "K.txt"
        file.write_text("\n".join(" ".join(map(str, row)) for row in options["K"]), encoding="ascii")
    try:
        scene = openmvg.reconstruct(str(photos), intrinsics=file and str(file), progress=False)
    except openmvg.OpenMVGError as error:
        return {"failed": str(error), "exit code": 1, "seconds": {}, "peak MB": peak_mb()}
    scene.write_colmap(str(out / "text"))
    return {"failed": "", "exit code": 0, "seconds": {"map": time.perf_counter() - start}, "peak MB": peak_mb()}


def main() -> None:
    kind, photos, out, text = sys.argv[1:]
    make: Callable[[Path, Path, Mapping[str, Any]], dict[str, Any]] = partial(run_stock, mapper=kind)
    found = {OURS: run_ours, OPENMVG: run_openmvg}.get(kind, make)(Path(photos), Path(out), json.loads(text))
    found["CPU seconds"] = cpu_seconds()
    if kind == OPENMVG and not found["failed"]:
        import pycolmap  # imported late: its cost is not the method's

        (Path(out) / "sparse").mkdir()
        pycolmap.Reconstruction(Path(out) / "text" / "sparse" / "0").write(Path(out) / "sparse")
    (Path(out) / RESULT).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
