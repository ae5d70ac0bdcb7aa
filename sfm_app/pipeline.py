"""The stages in order: the program's table of contents, and the loop that runs them."""

import hashlib
import logging
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

from sfm_app.colmap.backend import check_written
from sfm_app.colmap.backend import versions as colmap_versions
from sfm_app.colmap.model import sparse_model
from sfm_app.context import RunContext
from sfm_app.errors import BackendError, ConfigError, DamagedProductError, InputError, SfmError
from sfm_app.parallel import ordered_map
from sfm_app.photos import head_of, is_video, place_of
from sfm_app.stages.depth_maps import make_depth_maps
from sfm_app.stages.files import load_files, write_files
from sfm_app.stages.frames import photos_of, settings_for
from sfm_app.stages.intrinsics import calibrate, load_intrinsics
from sfm_app.stages.match_graph import load_match_graph, match_photos
from sfm_app.stages.mesh import load_surface, make_mesh
from sfm_app.stages.photos import files_of, load_photo_set, mask_folder, masks_of, read_photos
from sfm_app.stages.scene import load_scene, reconstruct_scene
from sfm_app.stages.texture import load_texture, make_texture
from sfm_app.stages.view_graph import build_view_graph, load_view_graph
from sfm_app.types import Model, PhotoSet
from sfm_app.workspace import StageRecord, fingerprint

logger = logging.getLogger("sfm_app")

Products = Callable[[str], Any]
"""Gives the product of an earlier stage by its name, loading it when that stage was skipped."""


@dataclass(frozen=True, slots=True)
class Stage:
    """One step from photos to mesh."""

    name: str
    takes: tuple[str, ...]
    """Stages whose products it needs."""
    settings: tuple[str, ...]
    """Tables of the settings that its result depends on."""
    files: tuple[str, ...]
    """What it leaves in the output folder."""
    make: Callable[[Products, RunContext], Any]
    load: Callable[[Products, RunContext], Any]


STAGES = (
    Stage(
        "photos", (), ("photos",), ("photos.json", "photos", "frames", "masks"),
        make=lambda products, run: photos_from(products("folder"), run),
        load=lambda _, run: load_photo_set(run),
    ),
    Stage(
        "match_graph", ("photos",), ("matching",), ("database.db",),
        make=lambda products, run: match_photos(products("photos"), run),
        load=lambda products, run: load_match_graph(products("photos"), run),
    ),
    Stage(
        "view_graph", ("match_graph",), ("epipolar", "seed"), ("view_graph.npz",),
        make=lambda products, run: build_view_graph(products("match_graph"), run),
        load=lambda _, run: load_view_graph(run),
    ),
    Stage(
        "intrinsics", ("match_graph", "view_graph"), ("calibration", "photos", "seed"), ("calibration.json",),
        make=lambda products, run: calibrate(products("match_graph"), products("view_graph"), run),
        load=lambda _, run: load_intrinsics(run),
    ),
    Stage(
        "scene", ("photos", "match_graph", "view_graph", "intrinsics"), ("scene", "epipolar", "seed"), ("sparse",),
        make=lambda products, run: reconstruct_scene(
            products("match_graph"), products("view_graph"), products("intrinsics"), run
        ),
        load=lambda products, run: load_scene(products("photos"), products("intrinsics"), run),
    ),
    Stage(
        "depth_maps", ("scene",), ("depth",), ("dense",),
        make=lambda products, run: make_depth_maps(
            products("scene"), run.workspace.photos, run.workspace.dense, run.settings.depth, run
        ),
        load=lambda _, run: run.workspace.dense,
    ),
    Stage(
        "mesh", ("depth_maps",), ("mesh",), ("dense/surface.npz",),
        make=lambda products, run: make_mesh(products("depth_maps"), run.settings.mesh, run),
        load=lambda _, run: load_surface(run.workspace.dense),
    ),
    Stage(
        "texture", ("scene", "mesh"), ("texture",), ("dense/texture.npz",),
        make=lambda products, run: make_texture(products("scene"), products("mesh"), run.settings.texture, run),
        load=lambda _, run: load_texture(run.workspace.dense),
    ),
    Stage(
        "files", ("texture",), (), ("model.ply", "model.glb"),
        make=lambda products, run: write_files(products("texture"), run),
        load=lambda _, run: load_files(run),
    ),
)  # fmt: skip

NAMES = tuple(stage.name for stage in STAGES)


def stored_model(run: RunContext, *, points: bool = False) -> Model:
    """The finished model, or the points and cameras, that a run left behind; nothing is computed.

    Raises:
        InputError: the run has not come so far (says which stage is missing), or its files are gone or damaged.
    """
    place = run.workspace
    if not place.manifest().get("stages"):
        raise InputError(f"{place.root} holds no run", hint="name the folder that `sfm-app run PHOTOS -o OUT` wrote")
    for name in ("scene",) if points else STAGES[-1].takes:
        if place.record(name) is None:
            raise InputError(
                f"{place.root} holds no {'points' if points else 'model'} yet: stage `{name}` is missing",
                hint=_how_on(run),
            )
    try:
        return sparse_model(place.sparse) if points else loader({}, run)("texture")
    except OSError as err:
        raise InputError(f"{place.root} is not complete: {err.strerror}: {err.filename}", hint=_how_on(run)) from err


def _how_on(run: RunContext) -> str:
    go_on = f"`sfm-app run PHOTOS -o {run.workspace.root}` goes on where it stopped"
    return f"{go_on}; `--points` exports the points and cameras" if run.workspace.record("scene") else go_on


def loader(found: dict[str, Any], run: RunContext) -> Products:
    """Gives what is in `found`, and loads what is not."""

    def products(name: str) -> Any:
        if name not in found:
            try:
                found[name] = STAGES[NAMES.index(name)].load(products, run)
            except DamagedProductError:
                raise
            except (OSError, ValueError, TypeError, LookupError, BadZipFile, EOFError, BackendError) as err:
                what = "is damaged"
                if isinstance(err, FileNotFoundError):
                    what = f"is not complete: {err.filename} is gone"
                left = f"what stage `{name}` left in {run.workspace.root} {what}"
                raise DamagedProductError(left, _how_on(run), name) from err
        return found[name]

    return products


def run_stages(
    folder: Path, run: RunContext, first: str = "", last: str = "files", wanted: Sequence[str] = ()
) -> Products:
    """Run what is not up to date, up to stage `last`; everything from stage `first` on is done again.

    The folder may be a video.
    Stages whose files are damaged are done again, too. The products of the stages `wanted` are read before it ends.

    Raises:
        SfmError: see errors.py; what was finished before stays valid.
    """
    for name in filter(None, (first, last)):
        if name not in NAMES:
            raise ConfigError(f"no stage is named '{name}'", hint=f"stages: {', '.join(NAMES)}")
    run.settings = settings_for(folder, run.settings)
    run.workspace.keep_apart(folder)
    photos = source_fingerprint(folder, run)
    run.workspace.create()
    with run.workspace.held(), logged(run):
        for _ in STAGES:
            try:
                return _through((folder, photos), run, (first, last), wanted)
            except DamagedProductError as err:
                logger.info("%s", err)
                run.progress.stage(err.stage, "damaged: done again")
                first = err.stage
        return _through((folder, photos), run, (first, last), wanted)


def _through(folder: tuple[Path, str], run: RunContext, ends: tuple[str, str], wanted: Sequence[str]) -> Products:
    """As `run_stages`, once; the folder with its fingerprint."""
    first, last = ends
    found: dict[str, Any] = {"folder": folder[0]}
    prints: dict[str, str] = {"folder": folder[1]}
    products = loader(found, run)
    redo = False
    for stage in STAGES[: NAMES.index(last) + 1]:
        prints[stage.name] = stage_fingerprint(stage, prints, run)
        redo = redo or stage.name == first or not run.workspace.is_current(stage.name, prints[stage.name])
        if not redo:
            run.progress.stage(stage.name, "up to date")
            continue
        run.workspace.forget(NAMES[NAMES.index(stage.name) :])
        found[stage.name] = make(stage, products, prints[stage.name], run)
    for name in wanted:
        if NAMES.index(name) <= NAMES.index(last):
            products(name)
    return products


def make(stage: Stage, products: Products, print_of_inputs: str, run: RunContext) -> Any:
    """Run one stage and enter it in the manifest."""
    run.progress.stage(stage.name)
    run.counts, run.inputs = {}, print_of_inputs
    start = time.perf_counter()
    try:
        product = stage.make(products, run)
    except SfmError as err:
        if isinstance(err, BackendError):
            check_written(*(path for path in run.workspace.root.iterdir() if path.is_file()))
        logger.info("%s stopped: %s; counted so far: %s", stage.name, err, run.counts)
        raise
    seconds = round(time.perf_counter() - start, 2)
    sizes = run.workspace.sizes(stage.files)
    record = StageRecord(print_of_inputs, seconds, run.counts, sizes, peak_memory_mb())
    run.workspace.finish(stage.name, record, manifest_head(run))
    logger.info("%s took %.2f s", stage.name, seconds)
    run.progress.stage_done(seconds)
    return product


def peak_memory_mb() -> int | None:
    """Most memory that this process has held; None where the system is not Linux."""
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text(encoding="utf-8")) if status.exists() else None
    return int(found[1]) // 1024 if found else None


def photos_from(source: Path, run: RunContext) -> PhotoSet:
    """The photos of a folder, or the frames of a video."""
    with photos_of(source, run) as folder:
        return read_photos(folder, run)


def source_fingerprint(source: Path, run: RunContext) -> str:
    """Hash of the names and bytes of all files in the photo folder, or of a video, and in that of the masks."""
    parts: list[Any] = [str(source.resolve())]
    parts += [digest(source)] if is_video(head_of(source)) else _contents(source, files_of(source, run), run)
    masks = mask_folder(run)
    if masks is not None:
        parts += [str(masks.resolve()), *_contents(masks, masks_of(source, run), run)]
    return fingerprint(*parts)


def _contents(folder: Path, names: Sequence[str], run: RunContext) -> list[Any]:
    """Names and hashes of files in a folder; instead of a hash, why a file is not read."""

    def digest_of(name: str) -> str:
        place = place_of(folder, name)
        return place if isinstance(place, str) else digest(place)

    return [names, list(ordered_map(run.executor, digest_of, names, ahead=4 * run.workers))]


def digest(file: Path) -> str:
    """Hash of the bytes of a file."""
    try:
        with file.open("rb") as opened:
            return hashlib.file_digest(opened, "blake2b").hexdigest()
    except OSError:
        return "unreadable"


def stage_fingerprint(stage: Stage, prints: Mapping[str, str], run: RunContext) -> str:
    """Hash of everything that a stage's result depends on: its inputs, its settings, the versions."""
    settings = run.settings.model_dump()
    inputs = [prints[name] for name in stage.takes or ("folder",)]
    return fingerprint(stage.name, versions(), {name: settings[name] for name in stage.settings}, inputs)


def manifest_head(run: RunContext) -> dict[str, Any]:
    """What the manifest says besides the stages."""
    return {"program": "sfm-app", "versions": versions(), "settings": run.settings.model_dump()}


def versions() -> dict[str, str]:
    """Versions of what computes the result."""
    parts = ("sfm-app", "numpy", "numba", "opencv-contrib-python-headless", "open3d")
    return {name: version(name) for name in parts} | colmap_versions()


class LogFile(logging.FileHandler):
    """A log that says nothing of a full disk: the run does."""

    def handleError(self, record: logging.LogRecord) -> None:
        pass


@contextmanager
def logged(run: RunContext) -> Iterator[None]:
    """Keep a log in the output folder, with the traceback of whatever ends the run."""
    handler = LogFile(run.workspace.log, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    except BaseException:
        logger.exception("the run ended here")
        raise
    finally:
        logger.removeHandler(handler)
        handler.close()
