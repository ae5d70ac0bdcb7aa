"""The stages in order: the program's table of contents."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from sfm_app import products
from sfm_app.camera_files import read_given_cameras
from sfm_app.colmap.dense import digest_maps
from sfm_app.engine.execution import Pipeline
from sfm_app.engine.stage import Products, Stage
from sfm_app.errors import ConfigError
from sfm_app.frame.control_points import read_control_points
from sfm_app.frame.positions import GEO_TXT, read_positions
from sfm_app.frame.scale import MetricFrame
from sfm_app.photos.gather import expand, gather, is_single
from sfm_app.photos.source import read_source
from sfm_app.runtime.context import CONTROL_POINTS, GIVEN_CAMERAS, RunContext
from sfm_app.runtime.parallel import ordered_map
from sfm_app.stages import depth_maps, files, intrinsics, match_graph, mesh, photos, scale, scene, texture, view_graph
from sfm_app.types import Intrinsics, MatchGraph, Model, PhotoSet, Scene, Surface, ViewGraph
from sfm_app.wording import list_names

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
    photo_dir = inputs[0] if is_single(inputs) else place.root / ".inputs"
    if photo_dir not in inputs:
        if options.images:
            raise ConfigError("--images lists photos of one folder", hint="leave --images out")
        gather(inputs, photo_dir, place.root)
    if options.masks:
        place.check_no_overlap(Path(options.masks), "masks")
    if run.settings.calibration.file:
        run = replace(run, given=read_given_cameras(Path(run.settings.calibration.file)))
    source = read_source(photo_dir, place.root, options, partial(ordered_map, run.executor, ahead=4 * run.workers))
    files = [name for name in source.files if name]
    given = Path(options.positions) if options.positions else photo_dir / GEO_TXT
    if options.positions or given.is_file():
        positions, missing = read_positions(given, files)
        if missing:
            run.progress.say(f"{given} names photos that the folder does not have: {list_names(missing, 5)}")
        others = [name for name in source.files if (photo_dir / name).resolve() != given.resolve()]
        source = replace(source, files={name: source.files[name] for name in others}, positions=positions)
    if run.settings.scale.control_points:
        run = replace(run, control_points=read_control_points(Path(run.settings.scale.control_points), files))
    return PIPELINE.run(source, run, first, last, targets)
