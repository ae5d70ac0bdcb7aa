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
from typing import Any, cast

from sfm_app.colmap.backend import versions as colmap_versions
from sfm_app.colmap.database import matches_seal
from sfm_app.colmap.dense import MAPS
from sfm_app.colmap.model import sparse_model
from sfm_app.context import STANDARD_FORMATS, RunContext
from sfm_app.errors import ConfigError, DamagedProductError, InputError, SfmError
from sfm_app.parallel import ordered_map
from sfm_app.photos import place_of
from sfm_app.stages.depth_maps import make_depth_maps
from sfm_app.stages.files import NAME as MODEL
from sfm_app.stages.files import load_files, write_files
from sfm_app.stages.intrinsics import calibrate, intrinsics_seal, load_intrinsics
from sfm_app.stages.match_graph import load_match_graph, match_photos
from sfm_app.stages.mesh import SURFACE, load_surface, make_mesh
from sfm_app.stages.photos import files_of, load_photo_set, read_photos
from sfm_app.stages.scene import load_scene, reconstruct_scene
from sfm_app.stages.texture import TEXTURE, load_texture, make_texture
from sfm_app.stages.view_graph import build_view_graph, load_view_graph
from sfm_app.stored import seal
from sfm_app.types import Model
from sfm_app.workspace import StageRecord, Workspace, fingerprint

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
    seal: Callable[[Workspace], str]
    """Hash of what `load` reads and later stages leave alone: COLMAP hangs or ends on damaged files."""


STAGES = (
    Stage(
        "photos", (), ("photos",), ("photos.json", "photos"),
        make=lambda products, run: read_photos(products("folder"), run),
        load=lambda products, run: load_photo_set(products("folder"), run),
        seal=lambda place: seal(place.root, place.photo_set.name),
    ),
    Stage(
        "match_graph", ("photos",), ("matching",), ("database.db",),
        make=lambda products, run: match_photos(products("photos"), run),
        load=lambda products, run: load_match_graph(products("photos"), run),
        seal=lambda place: matches_seal(place.database),
    ),
    Stage(
        "view_graph", ("match_graph",), ("epipolar", "seed"), ("view_graph.npz",),
        make=lambda products, run: build_view_graph(products("match_graph"), run),
        load=lambda _, run: load_view_graph(run),
        seal=lambda place: seal(place.root, place.view_graph.name),
    ),
    Stage(
        "intrinsics", ("match_graph", "view_graph"), ("calibration", "photos", "seed"), ("calibration.json",),
        make=lambda products, run: calibrate(products("match_graph"), products("view_graph"), run),
        load=lambda _, run: load_intrinsics(run),
        seal=intrinsics_seal,
    ),
    Stage(
        "scene", ("photos", "match_graph", "view_graph", "intrinsics"), ("scene", "epipolar", "seed"), ("sparse",),
        make=lambda products, run: reconstruct_scene(
            products("match_graph"), products("view_graph"), products("intrinsics"), run
        ),
        load=lambda products, run: load_scene(products("photos"), products("intrinsics"), run),
        seal=lambda place: seal(place.root, place.sparse.name),
    ),
    Stage(
        "depth_maps", ("scene",), ("depth",), ("dense",),
        make=lambda products, run: make_depth_maps(
            products("scene"), run.workspace.photos, run.workspace.dense, run.settings.depth, run
        ),
        load=lambda _, run: run.workspace.dense,
        seal=lambda place: seal(place.dense, *MAPS),
    ),
    Stage(
        "mesh", ("depth_maps",), ("mesh",), ("dense/surface.npz",),
        make=lambda products, run: make_mesh(products("depth_maps"), run.settings.mesh, run),
        load=lambda _, run: load_surface(run.workspace.dense),
        seal=lambda place: seal(place.dense, SURFACE),
    ),
    Stage(
        "texture", ("scene", "mesh"), ("texture",), ("dense/texture.npz",),
        make=lambda products, run: make_texture(products("scene"), products("mesh"), run.settings.texture, run),
        load=lambda _, run: load_texture(run.workspace.dense),
        seal=lambda place: seal(place.dense, TEXTURE),
    ),
    Stage(
        "files", ("texture",), (), ("model.ply", "model.glb"),
        make=lambda products, run: write_files(products("texture"), run),
        load=lambda _, run: load_files(run),
        seal=lambda place: seal(place.root, *(f"{MODEL}.{suffix}" for suffix in STANDARD_FORMATS)),
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
    if not points:
        return cast(Model, loader({}, run)("texture"))
    with undamaged("scene", run):
        return sparse_model(place.sparse)


def _how_on(run: RunContext) -> str:
    go_on = f"`sfm-app run PHOTOS -o {run.workspace.root}` goes on where it stopped"
    return f"{go_on}; `--points` exports the points and cameras" if run.workspace.record("scene") else go_on


def loader(found: dict[str, Any], run: RunContext) -> Products:
    """Gives what is in `found`, and loads what is not."""

    def products(name: str) -> Any:
        if name not in found:
            with undamaged(name, run):
                found[name] = STAGES[NAMES.index(name)].load(products, run)
        return found[name]

    return products


@contextmanager
def undamaged(name: str, run: RunContext) -> Iterator[None]:
    """Check what a stage has left, and read it.

    Raises:
        DamagedProductError: it is not as it was left, or cannot be read.
    """
    try:
        record = run.workspace.record(name)
        if record is None or record.seal != STAGES[NAMES.index(name)].seal(run.workspace):
            raise ValueError(f"the files of stage `{name}` are not as it left them")
        yield
    except InputError:
        raise
    except Exception as err:  # whatever decoders make of damaged bytes
        what = f"is not complete: {err.filename} is gone" if isinstance(err, FileNotFoundError) else "is damaged"
        left = f"what stage `{name}` left in {run.workspace.root} {what}"
        raise DamagedProductError(left, _how_on(run), name) from err


def run_stages(
    folder: Path, run: RunContext, first: str = "", last: str = "files", wanted: Sequence[str] = ()
) -> Products:
    """Run what is not up to date, up to stage `last`; everything from stage `first` on is done again.

    Stages whose files are damaged are done again, too. The products of the stages `wanted` are read before it ends.

    Raises:
        SfmError: see errors.py; what was finished before stays valid.
    """
    for name in filter(None, (first, last)):
        if name not in NAMES:
            raise ConfigError(f"no stage is named '{name}'", hint=f"stages: {', '.join(NAMES)}")
    photos = folder_fingerprint(folder, run)
    run.workspace.create()
    with run.workspace.held(), logged(run):
        for _ in STAGES:
            try:
                return _through((folder, photos), run, (first, last), wanted)
            except DamagedProductError as err:
                logger.info("%s", err, exc_info=err)
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
        logger.info("%s stopped: %s; counted so far: %s", stage.name, err, run.counts)
        raise
    seconds = round(time.perf_counter() - start, 2)
    sizes = run.workspace.sizes(stage.files)
    record = StageRecord(print_of_inputs, seconds, run.counts, sizes, peak_memory_mb(), stage.seal(run.workspace))
    run.workspace.finish(stage.name, record, manifest_head(run))
    logger.info("%s took %.2f s", stage.name, seconds)
    run.progress.stage_done(seconds)
    return product


def peak_memory_mb() -> int | None:
    """Most memory that this process has held; None where the system is not Linux."""
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text(encoding="utf-8")) if status.exists() else None
    return int(found[1]) // 1024 if found else None


def folder_fingerprint(folder: Path, run: RunContext) -> str:
    """Hash of the names and bytes of all files in the photo folder."""
    names = files_of(folder, run)

    def digest(name: str) -> str:
        place = place_of(folder, name)
        if isinstance(place, str):
            return place
        try:
            with place.open("rb") as file:
                return hashlib.file_digest(file, "blake2b").hexdigest()
        except OSError:
            return "unreadable"

    return fingerprint(
        str(folder.resolve()), names, list(ordered_map(run.executor, digest, names, ahead=4 * run.workers))
    )


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


@contextmanager
def logged(run: RunContext) -> Iterator[None]:
    """Keep a log in the output folder, with the traceback of whatever ends the run."""
    handler = logging.FileHandler(run.workspace.log, encoding="utf-8", errors="backslashreplace")
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
