"""The stages in order: the program's table of contents."""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

from sfm_app import products
from sfm_app.camera_files import read_given_cameras
from sfm_app.colmap.dense import digest_maps
from sfm_app.engine.execution import Pipeline
from sfm_app.engine.stage import Products, Stage
from sfm_app.errors import ConfigError, InputError
from sfm_app.frame.control_points import read_control_points
from sfm_app.frame.positions import GEO_TXT, read_positions
from sfm_app.frame.scale import MetricFrame
from sfm_app.photos.gather import expand, fill, find, is_single, remove
from sfm_app.photos.source import Source, read_source
from sfm_app.runtime.context import CONTROL_POINTS, GIVEN_CAMERAS, RunContext
from sfm_app.runtime.parallel import ordered_map
from sfm_app.stages import depth_maps, files, intrinsics, match_graph, mesh, photos, scale, scene, texture, view_graph
from sfm_app.types import GpsPosition, Intrinsics, MatchGraph, Model, PhotoSet, Scene, Surface, ViewGraph

PHOTOS: Stage[PhotoSet] = Stage(
    name="photos",
    takes=(),
    settings=("photos", "max_memory_gb", GIVEN_CAMERAS),
    files=("photos.json", "photos", "frames", "masks"),
    make=lambda given, run: photos.make(given.source, run),
    load=lambda given, run: photos.load(given.source, run),
    digest=products.hash_photos,
)
MATCH_GRAPH: Stage[MatchGraph] = Stage(
    name="match_graph",
    takes=(PHOTOS,),
    settings=("matching",),
    files=("database.db",),
    make=lambda given, run: match_graph.make(given[PHOTOS], run),
    load=lambda given, run: products.read_matches(given[PHOTOS], run.workspace),
    digest=products.hash_matches,
    grows=True,
)
VIEW_GRAPH: Stage[ViewGraph] = Stage(
    name="view_graph",
    takes=(MATCH_GRAPH,),
    settings=("epipolar", *view_graph.LENS_SETTINGS, "seed"),
    files=("view_graph.npz",),
    make=lambda given, run: view_graph.make(given[MATCH_GRAPH], run),
    load=lambda _, run: products.read_view_graph(run.workspace),
    digest=products.hash_view_graph,
    grows=True,
)
INTRINSICS: Stage[Intrinsics] = Stage(
    name="intrinsics",
    takes=(MATCH_GRAPH, VIEW_GRAPH),
    settings=("calibration", "photos.cameras", GIVEN_CAMERAS, "seed"),
    files=("calibration.json",),
    make=lambda given, run: intrinsics.make(given[MATCH_GRAPH], given[VIEW_GRAPH], run),
    load=lambda _, run: products.read_intrinsics(run.workspace),
    digest=products.hash_intrinsics,
    grows=True,
)
SCENE: Stage[Scene] = Stage(
    name="scene",
    takes=(PHOTOS, MATCH_GRAPH, VIEW_GRAPH, INTRINSICS),
    settings=("scene", "epipolar", "seed"),
    files=("sparse", "scene.json"),
    make=lambda given, run: scene.make(given[MATCH_GRAPH], given[VIEW_GRAPH], given[INTRINSICS], run),
    load=lambda _, run: products.read_scene(run.workspace),
    digest=products.hash_scene,
    grows=True,
)
SCALE: Stage[MetricFrame] = Stage(
    name="scale",
    takes=(PHOTOS, SCENE),
    settings=("scale", CONTROL_POINTS),
    files=("scale.json",),
    make=lambda given, run: scale.make(given[PHOTOS], given[SCENE], run),
    load=lambda _, run: products.read_frame(run.workspace),
    digest=products.hash_frame,
)
DEPTH_MAPS: Stage[Path] = Stage(
    name="depth_maps",
    takes=(SCENE,),
    settings=("depth",),
    files=("dense",),
    make=lambda given, run: depth_maps.make(given[SCENE], run),
    load=lambda _, run: run.workspace.dense,
    digest=lambda place: digest_maps(place.dense),
)
MESH: Stage[Surface] = Stage(
    name="mesh",
    takes=(SCENE, DEPTH_MAPS),
    settings=("mesh", "texture.normal_map"),
    files=("surface/surface.npz", "surface/fine.npz"),
    make=lambda given, run: mesh.make(given[SCENE], given[DEPTH_MAPS], run),
    load=lambda _, run: products.read_surface(run.workspace),
    digest=products.hash_surface,
)
TEXTURE: Stage[Model] = Stage(
    name="texture",
    takes=(SCENE, MESH),
    settings=("texture",),
    files=("texture/texture.npz",),
    make=lambda given, run: texture.make(given[SCENE], given[MESH], run),
    load=lambda _, run: products.read_texture(run.workspace),
    digest=products.hash_texture,
)
MODEL_FILES = ("model.ply", "model.glb")
FILES: Stage[tuple[Path, ...]] = Stage(
    name="files",
    takes=(SCALE, TEXTURE),
    settings=(),
    files=MODEL_FILES,
    make=lambda given, run: files.make(given[TEXTURE], given[SCALE], run),
    load=lambda _, run: tuple(run.workspace.root / name for name in MODEL_FILES),
    digest=products.hash_files(*MODEL_FILES),
)

PIPELINE = Pipeline(PHOTOS, (MATCH_GRAPH, VIEW_GRAPH, INTRINSICS, SCENE, SCALE, DEPTH_MAPS, MESH, TEXTURE, FILES))
STAGES, NAMES = PIPELINE.stages, PIPELINE.names


def run_stages(
    inputs: Sequence[Path], run: RunContext, first: str = "", last: str = "files", targets: Sequence[Stage[object]] = ()
) -> Products:
    """Turn photos, folders and archives, or a video, into products; the rest as in `Pipeline.run`."""
    options, place = run.settings.photos, run.workspace
    inputs = expand(inputs)
    for path in inputs:
        place.check_no_overlap(path)
    if options.masks:
        place.check_no_overlap(Path(options.masks), "masks")
    if run.settings.calibration.file:
        run = replace(run, given=read_given_cameras(Path(run.settings.calibration.file)))
    with _open_source(inputs, run) as opened:
        source, files = _with_positions(opened, run), [name for name in opened.files if name]
        if run.settings.scale.control_points:
            run = replace(run, control_points=read_control_points(Path(run.settings.scale.control_points), files))
        return PIPELINE.run(source, run, first, last, targets)


@contextmanager
def _open_source(inputs: Sequence[Path], run: RunContext) -> Iterator[Source]:
    """Provide the photos; several inputs are gathered in the output folder, which stays locked for the block."""
    options, place = run.settings.photos, run.workspace
    spread = partial(ordered_map, run.executor, ahead=4 * run.workers)
    if is_single(inputs, place.root):
        source = read_source(inputs[0], place.root, options, spread)
        if place.inputs.exists():  # of an earlier run
            with place.hold_lock():
                remove(place.inputs)
        yield source
        return
    if options.images:
        raise ConfigError("--images lists photos of one folder", hint="leave --images out")
    found, is_new = find(inputs, place.root, options.masks), not place.root.exists()
    place.create()
    with place.hold_lock():
        try:
            fill(place.inputs, found, spread)
            source = read_source(place.inputs, place.root, options, spread)
        except InputError:
            if is_new:  # a refused input leaves nothing behind
                shutil.rmtree(place.root, ignore_errors=True)
            raise
        videos, beside = found.videos(place.inputs)
        files = {name: digest for name, digest in source.files.items() if name not in beside}
        left_out = {**source.left_out, **found.left_out, **beside}
        yield replace(source, files=files, left_out=left_out, named=found.labels, videos=videos)


def _with_positions(source: Source, run: RunContext) -> Source:
    """Return the photos with the positions of the user's file, or of each geo.txt beside them, which is no photo."""
    names = [name for name in source.files if source.named and PurePosixPath(name).name == GEO_TXT]
    given = [(source.path / name, name.removesuffix(GEO_TXT)) for name in names or [GEO_TXT]]
    if run.settings.photos.positions:
        given = [(Path(run.settings.photos.positions), "")]
    elif not all(path.is_file() for path, _ in given):
        return source
    known, absent = dict[str, GpsPosition](), dict[str, list[str]]()
    for path, folder in given:
        inside = [name.removeprefix(folder) for name in source.files if name and name.startswith(folder)]
        place = source.named.get(f"{folder}{GEO_TXT}", str(path))
        try:
            positions, absent[place if source.named else path.name] = read_positions(path, inside)
        except InputError as err:
            raise InputError(err.message.replace(str(path), place), hint=err.hint) from err
        for name, position in positions.items():
            if known.setdefault(folder + name, position) != position:
                label = source.label(folder + name)
                raise InputError(f"two geo.txt give {label} other positions", hint="name one file with --positions")
    places = {path.resolve() for path, _ in given}
    files = {name: digest for name, digest in source.files.items() if (source.path / name).resolve() not in places}
    missing = {place: names for place, names in absent.items() if names}
    return replace(source, files=files, positions=known, missing=missing)
