"""The stages in order: the program's table of contents."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera_files import read_given_cameras
from sfm_app.colmap.model import sparse_model
from sfm_app.engine.execution import Pipeline
from sfm_app.engine.stage import Products, Stage, check_undamaged, resume_hint
from sfm_app.errors import InputError
from sfm_app.photos import read_source
from sfm_app.runtime.context import CONTROL_POINTS, GIVEN_CAMERAS, RunContext
from sfm_app.runtime.parallel import ordered_map
from sfm_app.scale import MetricFrame, move_model, read_control_points
from sfm_app.scale.measuring import Distance, measure_distance
from sfm_app.scale.photo_rays import PosedPhotos
from sfm_app.stages import depth_maps, export, intrinsics, match_graph, mesh, photos, scale, scene, texture, view_graph
from sfm_app.types import Intrinsics, MatchGraph, Model, PhotoSet, Scene, Surface, ViewGraph

PHOTOS: Stage[PhotoSet] = Stage(
    name="photos",
    takes=(),
    settings=("photos", "max_memory_gb", GIVEN_CAMERAS),
    files=("photos.json", "photos", "frames", "masks"),
    make=lambda given, run: photos.make(given.source, run),
    load=lambda given, run: photos.load(given.source, run),
    digest=photos.digest,
)
MATCH_GRAPH: Stage[MatchGraph] = Stage(
    name="match_graph",
    takes=(PHOTOS,),
    settings=("matching",),
    files=("database.db",),
    make=lambda given, run: match_graph.make(given[PHOTOS], run),
    load=lambda given, run: match_graph.load(given[PHOTOS], run),
    digest=match_graph.digest,
    grows=True,
)
VIEW_GRAPH: Stage[ViewGraph] = Stage(
    name="view_graph",
    takes=(MATCH_GRAPH,),
    settings=("epipolar", *view_graph.LENS_SETTINGS, "seed"),
    files=("view_graph.npz",),
    make=lambda given, run: view_graph.make(given[MATCH_GRAPH], run),
    load=lambda _, run: view_graph.load(run),
    digest=view_graph.digest,
    grows=True,
)
INTRINSICS: Stage[Intrinsics] = Stage(
    name="intrinsics",
    takes=(MATCH_GRAPH, VIEW_GRAPH),
    settings=("calibration", "photos.cameras", GIVEN_CAMERAS, "seed"),
    files=("calibration.json",),
    make=lambda given, run: intrinsics.make(given[MATCH_GRAPH], given[VIEW_GRAPH], run),
    load=lambda _, run: intrinsics.load(run),
    digest=intrinsics.digest,
    grows=True,
)
SCENE: Stage[Scene] = Stage(
    name="scene",
    takes=(PHOTOS, MATCH_GRAPH, VIEW_GRAPH, INTRINSICS),
    settings=("scene", "epipolar", "seed"),
    files=("sparse", "scene.json"),
    make=lambda given, run: scene.make(given[MATCH_GRAPH], given[VIEW_GRAPH], given[INTRINSICS], run),
    load=lambda _, run: scene.load(run),
    digest=scene.digest,
    grows=True,
)
SCALE: Stage[MetricFrame] = Stage(
    name="scale",
    takes=(PHOTOS, SCENE),
    settings=("scale", CONTROL_POINTS),
    files=("scale.json",),
    make=lambda given, run: scale.make(given[PHOTOS], given[SCENE], run),
    load=lambda _, run: scale.load(run),
    digest=scale.digest,
)
DEPTH_MAPS: Stage[Path] = Stage(
    name="depth_maps",
    takes=(SCENE,),
    settings=("depth",),
    files=("dense",),
    make=lambda given, run: depth_maps.make(given[SCENE], run),
    load=lambda _, run: depth_maps.load(run),
    digest=depth_maps.digest,
)
MESH: Stage[Surface] = Stage(
    name="mesh",
    takes=(DEPTH_MAPS,),
    settings=("mesh",),
    files=("surface/surface.npz",),
    make=lambda given, run: mesh.make(given[DEPTH_MAPS], run),
    load=lambda _, run: mesh.load(run),
    digest=mesh.digest,
)
TEXTURE: Stage[Model] = Stage(
    name="texture",
    takes=(SCENE, MESH),
    settings=("texture",),
    files=("texture/texture.npz",),
    make=lambda given, run: texture.make(given[SCENE], given[MESH], run),
    load=lambda _, run: texture.load(run),
    digest=texture.digest,
)
FILES: Stage[tuple[Path, ...]] = Stage(
    name="files",
    takes=(SCALE, TEXTURE),
    settings=(),
    files=("model.ply", "model.glb"),
    make=lambda given, run: export.make(given[TEXTURE], given[SCALE], run),
    load=lambda _, run: export.load(run),
    digest=export.digest,
)

PIPELINE = Pipeline(PHOTOS, (MATCH_GRAPH, VIEW_GRAPH, INTRINSICS, SCENE, SCALE, DEPTH_MAPS, MESH, TEXTURE, FILES))
STAGES, NAMES = PIPELINE.stages, PIPELINE.names


def run_stages(
    photo_dir: Path, run: RunContext, first: str = "", last: str = "files", wanted: Sequence[Stage[object]] = ()
) -> Products:
    """Turn a folder of photos, or a video, into products.

    Args:
        photo_dir, run, wanted: folder or video; the run; stages whose products are loaded before returning.
        first, last: stage from which on everything is redone, empty for none; stage to stop after.
    """
    options, place = run.settings.photos, run.workspace
    place.check_no_overlap(photo_dir)
    if options.masks:
        place.check_no_overlap(Path(options.masks), "masks")
    if run.settings.calibration.file:
        run = replace(run, given=read_given_cameras(Path(run.settings.calibration.file)))
    if run.settings.scale.control_points:
        run = replace(run, control_points=read_control_points(Path(run.settings.scale.control_points)))
    source = read_source(photo_dir, place.root, options, partial(ordered_map, run.executor, ahead=4 * run.workers))
    source.check_settings(run.settings)
    return PIPELINE.run(source, run, first, last, wanted)


def stored_model(run: RunContext, *, points: bool = False) -> Model:
    """Read the finished model, or the points and cameras, of a run; nothing is computed.

    Args:
        run, points: the finished run; whether to read the points and cameras instead of the textured surface.

    Raises:
        InputError: a stage has not run yet (the message names it), or its files are missing or damaged.
    """
    _check_finished(SCENE if points else TEXTURE, "points" if points else "model", run)
    frame, place = stored_frame(run), run.workspace
    if not points:
        return move_model(Products(run)[TEXTURE], frame.from_model)
    with check_undamaged(SCENE, run):
        return move_model(sparse_model(place.sparse), frame.from_model)


def stored_distance(run: RunContext, ends: NDArray[np.float64]) -> Distance:
    """Return the distance between two places in the frame of exported files.

    Args:
        run: the finished run.
        ends: (2, 3) the places.

    Raises:
        ValueError: both are the same.
        InputError: the run has no poses yet, or its files are damaged.
    """
    _check_finished(SCENE, "camera poses", run)
    frame = stored_frame(run)
    a, b = frame.from_model.inverse()(ends)
    with check_undamaged(SCENE, run):
        model = PosedPhotos(run.workspace.sparse).sightlines()
    return measure_distance(a, b, model, frame.from_model.scale, frame.deviation)


def _check_finished(needed: Stage[object], what: str, run: RunContext) -> None:
    """Check that a run has finished a stage.

    Args:
        needed: the stage.
        what: it gives, for the message.
        run: the run.

    Raises:
        InputError: it has not; the message names the stage.
    """
    manifest = run.workspace.manifest
    if not manifest.read().get("stages"):
        hint = "name the folder that `sfm-app run PHOTOS -o OUT` wrote"
        raise InputError(f"{run.workspace.root} holds no run", hint=hint)
    manifest.check_format()
    if manifest.record(needed.name) is None:
        more = "; `--points` exports the points and cameras" if manifest.record(SCENE.name) else ""
        missing = f"{run.workspace.root} holds no {what} yet: stage `{needed.name}` is missing"
        raise InputError(missing, hint=resume_hint(run) + more)


def stored_frame(run: RunContext) -> MetricFrame:
    """Return the frame of exported files; that of the model where nothing is known of its size.

    Args:
        run: the finished run.
    """
    known = run.workspace.manifest.record(SCALE.name) is not None
    return Products(run)[SCALE] if known else MetricFrame()
