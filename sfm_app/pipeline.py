"""The stages in order: the program's table of contents, and the loop that runs them."""

import logging
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import dropwhile
from pathlib import Path
from typing import Any, cast

from sfm_app.colmap.backend import check_written
from sfm_app.colmap.database import matches_seal
from sfm_app.colmap.dense import MAPS
from sfm_app.colmap.model import sparse_model
from sfm_app.context import STANDARD_FORMATS, RunContext
from sfm_app.cost_estimate import plan_within
from sfm_app.errors import BackendError, ConfigError, DamagedProductError, InputError
from sfm_app.hashing import seal
from sfm_app.manifest import StageRecord
from sfm_app.stages.depth_maps import make_depth_maps
from sfm_app.stages.export import NAME as MODEL
from sfm_app.stages.export import load_files, write_files
from sfm_app.stages.intrinsics import calibrate, intrinsics_seal, load_intrinsics
from sfm_app.stages.match_graph import load_match_graph, match_photos
from sfm_app.stages.mesh import SURFACE, load_surface, make_mesh
from sfm_app.stages.photos import load_photo_set, read_photos
from sfm_app.stages.scene import load_scene, reconstruct_scene
from sfm_app.stages.texture import TEXTURE, load_texture, make_texture
from sfm_app.stages.video_frames import folder_of, photos_of, settings_for
from sfm_app.stages.view_graph import build_view_graph, load_view_graph
from sfm_app.staleness import OTHER_PHOTOS, Source, made_with, manifest_head, source_of, stage_print, why_again
from sfm_app.types import Model, PhotoSet
from sfm_app.workspace import Workspace

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
    """Settings, or tables of them, that its result depends on."""
    files: tuple[str, ...]
    """What it leaves in the output folder."""
    make: Callable[[Products, RunContext], Any]
    load: Callable[[Products, RunContext], Any]
    seal: Callable[[Workspace], str]
    """Hash of what `load` reads and later stages leave alone: COLMAP hangs or ends on damaged files."""


STAGES = (
    Stage(
        "photos", ("source",), ("photos", "max_memory_gb"), ("photos.json", "photos", "frames", "masks"),
        make=lambda products, run: photos_from(products("source"), run),
        load=lambda products, run: load_photo_set(folder_of(products("source"), run), run),
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
        "intrinsics", ("match_graph", "view_graph"), ("calibration", "photos.cameras", "seed"), ("calibration.json",),
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
PHOTOS = NAMES[0]


def stored_model(run: RunContext, *, points: bool = False) -> Model:
    """Return the finished model, or the points and cameras, that a run left behind; nothing is computed.

    Raises:
        InputError: the run has not come so far (says which stage is missing), or its files are gone or damaged.
    """
    place = run.workspace
    if not place.manifest.read().get("stages"):
        raise InputError(f"{place.root} holds no run", hint="name the folder that `sfm-app run PHOTOS -o OUT` wrote")
    for name in ("scene",) if points else STAGES[-1].takes:
        if place.manifest.record(name) is None:
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
    return f"{go_on}; `--points` exports the points and cameras" if run.workspace.manifest.record("scene") else go_on


def loader(found: dict[str, Any], run: RunContext) -> Products:
    """Make what gives products that were found, and loads the others."""

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
        record = run.workspace.manifest.record(name)
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
    source: Path, run: RunContext, first: str = "", last: str = "files", wanted: Sequence[str] = ()
) -> Products:
    """Run what is not up to date, up to stage `last`; everything from stage `first` on is done again.

    Stages whose files are damaged are done again, too. The products of the stages `wanted` are read before it ends.

    Raises:
        SfmError: see errors.py; what was finished before stays valid.
    """
    for name in filter(None, (first, last)):
        if name not in NAMES:
            raise ConfigError(f"no stage is named '{name}'", hint=f"stages: {', '.join(NAMES)}")
    run.settings = settings_for(source, run.settings)
    run.workspace.keep_apart(source)
    inputs = source_of(source, run)
    run.workspace.create()
    with run.workspace.held(), logged(run):
        for _ in STAGES:
            try:
                return _through(inputs, run, (first, last), wanted)
            except DamagedProductError as err:
                logger.info("%s", err, exc_info=err)
                run.progress.stage(err.stage, "damaged: done again")
                forget(err.stage, run)
                first = ""
        return _through(inputs, run, (first, last), wanted)


def _through(source: Source, run: RunContext, ends: tuple[str, str], wanted: Sequence[str]) -> Products:
    """Run the stages once, as `run_stages` does."""
    first, last = ends
    found: dict[str, Any] = {"source": source.place}
    prints: dict[str, str] = {"source": source.print}
    products = loader(found, run)

    def do(stage: Stage, again: str | None) -> None:
        if again is None:
            run.progress.stage(stage.name, "up to date")
            return
        forget(stage.name, run)
        found[stage.name] = make(stage, products, (source, prints[stage.name]), again, run)

    do(STAGES[0], why(STAGES[0], prints, first, run))
    prints[PHOTOS] = source.content(products(PHOTOS))  # what else changed in the folder does not matter
    reasons = {stage.name: why(stage, prints, first, run) for stage in STAGES[1 : NAMES.index(last) + 1]}
    redone = PHOTOS if first == PHOTOS else ""
    ahead = list(dropwhile(lambda name: not redone and reasons[name] is None, reasons))
    with planned(products(PHOTOS), ahead, run):
        for stage in STAGES[1 : NAMES.index(last) + 1]:
            again = reasons[stage.name]
            do(stage, f"after {redone}" if redone and again in (None, OTHER_PHOTOS) else again)
            redone = redone if again is None else stage.name
    for name in wanted:
        if NAMES.index(name) <= NAMES.index(last):
            products(name)
    return products


@contextmanager
def planned(photos: PhotoSet, ahead: Sequence[str], run: RunContext) -> Iterator[None]:
    """Say what these stages will cost, and hold the memory that they may have.

    Raises:
        ConfigError: the photos need more than the user allows.
    """
    if not ahead:
        yield
        return
    plan = plan_within(photos.photos, run.settings, run.workers, run.memory_mb, ahead)
    if run.settings.max_memory_gb and plan.peak_mb(ahead) > run.memory_mb:
        raise ConfigError(
            f"{plan.photos} photos need about {plan.peak_mb(ahead) / 1000:.1f} GB, more than --max-memory",
            hint="allow more, use fewer photos, or --quality draft",
        )
    run.progress.say(plan.text(ahead))
    logger.info("%s", plan.text(ahead))
    with run.with_workers(plan.workers):
        yield


def why(stage: Stage, prints: dict[str, str], first: str, run: RunContext) -> str | None:
    """Say why a stage is done again, as `why_again`; enters what the stage depends on in `prints`."""
    prints[stage.name] = stage_print(stage.name, stage.settings, [prints[name] for name in stage.takes], run)
    again = why_again(stage.name, stage.settings, prints[stage.name], run)
    return "as asked" if again is None and stage.name == first else again


def forget(name: str, run: RunContext) -> None:
    """Take a stage out of the manifest, and those that build on its files; nobody builds on those of the photos."""
    run.workspace.manifest.forget((name,) if name == PHOTOS else NAMES[NAMES.index(name) :])


def photos_from(source: Path, run: RunContext) -> PhotoSet:
    """Return the photos of a folder, or the frames of a video."""
    with photos_of(source, run) as folder:
        return read_photos(folder, run)


def make(stage: Stage, products: Products, inputs: tuple[Source, str], again: str, run: RunContext) -> Any:
    """Run one stage and enter it in the manifest.

    Args:
        stage: to be run.
        products: of the stages before.
        inputs: what the user has given, and the fingerprint of all that the stage's result depends on.
        again: why it is done, where it was there before.
        run: the run.
    """
    run.progress.stage(stage.name, f"again: {again}" if again else "")
    logger.info("%s begins%s", stage.name, f" again: {again}" if again else "")
    run.counts, run.inputs = {}, inputs[1]
    start = time.perf_counter()
    try:
        product = stage.make(products, run)
        disturbed(inputs[0], product if stage.name == PHOTOS else products(PHOTOS), run)
    except Exception as err:
        logger.info("%s stopped: %s; counted so far: %s", stage.name, err, run.counts)
        disturbed(inputs[0], None if stage.name == PHOTOS else products(PHOTOS), run, by=err)
        raise
    seconds = round(time.perf_counter() - start, 2)
    sizes = run.workspace.manifest.sizes(stage.files)
    used = made_with(stage.settings, run)
    record = StageRecord(inputs[1], seconds, run.counts, sizes, peak_memory_mb(), used, stage.seal(run.workspace))
    run.workspace.manifest.finish(stage.name, record, manifest_head(run))
    logger.info("%s took %.2f s", stage.name, seconds)
    run.progress.stage_done(seconds)
    return product


def disturbed(source: Source, photos: PhotoSet | None, run: RunContext, by: Exception | None = None) -> None:
    """Check whether something from outside has disturbed a stage, and perhaps made it fail.

    Args:
        source: what the user has given.
        photos: that are used; None where nobody knows yet.
        run: the run.
        by: how the stage has failed, if it has.

    Raises:
        InputError: the output folder, or a photo, is not there any more, or is another one.
        OSError: the disk is full; COLMAP does not always say so.
    """
    run.workspace.check_there()
    try:
        if photos is not None:
            source.check(photos)
    except InputError as err:
        run.workspace.discard_unfinished()
        raise err from by
    if isinstance(by, BackendError):
        check_written(*(path for path in run.workspace.root.iterdir() if path.is_file()))


def peak_memory_mb() -> int | None:
    """Return the most memory that this process has held; None where the system is not Linux."""
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text(encoding="utf-8")) if status.exists() else None
    return int(found[1]) // 1024 if found else None


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
