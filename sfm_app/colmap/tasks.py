"""Tasks of COLMAP's worker processes, see `worker_process`; each task imports only what it needs."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from sfm_app.colmap.backend import check_written, largest_model, pycolmap, run_with_progress
from sfm_app.colmap.worker_process import (
    DefaultMappingTask,
    FeatureTask,
    FuseTask,
    GlobalMappingTask,
    MatchTask,
    PoissonTask,
    ProgressReporter,
    SimplifyTask,
    UndistortTask,
    report,
    serve,
)

JPEG_QUALITY = 98
UNDISTORTED_PHOTOS = {"COLMAP": "images", "PMVS": "pmvs/visualize"}
"""Folder of the undistorted photos, by layout."""


def work(task: Mapping[str, object]) -> None:
    """Do the task that its entry `do` names."""
    TASKS[str(task["do"])](task)


def find_and_match(task: FeatureTask) -> None:
    """Find features of photos, match pairs of photos, and report the effective options."""
    from sfm_app.colmap.features import do_feature_task

    do_feature_task(task, ProgressReporter(), report)


def match_chunk(task: MatchTask) -> None:
    """Match some pairs on one thread, and report the file with their rows."""
    from sfm_app.colmap.features import SiftInputs, SiftSettings, match_chunk
    from sfm_app.settings import MatchSettings

    options = MatchSettings.model_validate(task["options"])
    settings = SiftSettings(Path(task["photos"]), None, options, task["sift"])
    folder = Path(task["folder"])
    inputs = SiftInputs(Path(task["snapshot"]), Path(task["features"]), settings, folder, folder)
    part = match_chunk(inputs, [(int(a), int(b)) for a, b in task["pairs"]], ProgressReporter())
    report(path=str(part.path), in_force=dict(part.in_force))


def map_globally(task: GlobalMappingTask) -> None:
    """Run COLMAP's global mapper, and write the largest model into `model` in the scratch folder."""
    scratch, options = Path(task["scratch"]), global_options(task["seed"], task["names"])
    (scratch / "all").mkdir()
    models = pycolmap.global_mapping(scratch / "database.db", Path(task["photos"]), scratch / "all", options)
    _write_largest(models, scratch / "model")


def global_options(seed: int, names: Sequence[str]) -> pycolmap.GlobalPipelineOptions:
    """Return COLMAP's defaults, except that it uses our relative poses unchanged and adjusts coarsely.

    The last adjustment is ours.
    """
    options = pycolmap.GlobalPipelineOptions()
    options.image_names = list(names)
    options.min_model_size = 2
    options.decompose_relative_pose = False
    options.num_threads = options.mapper.num_threads = 1
    mapper = options.mapper
    mapper.ba_num_iterations = 2
    mapper.bundle_adjustment.ceres.solver_options.function_tolerance = 1e-3
    # on any machine the same bytes; without CUDA, COLMAP warns of it from 50 photos on
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    options.random_seed = mapper.random_seed = mapper.rotation_averaging.random_seed = seed
    mapper.global_positioning.random_seed = mapper.retriangulation.random_seed = seed
    return options


def map_with_defaults(task: DefaultMappingTask) -> None:
    """Verify the raw matches, map them with COLMAP's defaults, and write the largest model into `model`.

    Only seeds and the number of threads differ from the defaults: on several threads, results differ between runs.
    """
    scratch, seed = Path(task["scratch"]), task["seed"]
    database = scratch / "database.db"
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = seed
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = 1
    pycolmap.geometric_verification(database, verifier, two_view_geometry_options=geometry)
    (scratch / "all").mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    models = pycolmap.incremental_mapping(database, Path(task["photos"]), scratch / "all", options)
    _write_largest(models, scratch / "model")


def _write_largest(models: Mapping[int, pycolmap.Reconstruction], folder: Path) -> None:
    model = largest_model(models)
    if model is not None:
        folder.mkdir()
        model.write(folder)
        check_written(*folder.iterdir())


def undistort(task: UndistortTask) -> None:
    """Write undistorted photos and their model into a dense workspace.

    COLMAP's JPEG writer ends the process when the disk is full.
    """
    dense_dir, model_dir = Path(task["dense"]), Path(task["model"])
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = task["max_side_px"]
    photos = dense_dir / UNDISTORTED_PHOTOS[task["output"]]

    def call(token: pycolmap.CancellationToken) -> None:
        pycolmap.undistort_images(
            dense_dir, model_dir, Path(task["photos"]), undistort_options=options, jpeg_quality=JPEG_QUALITY,
            num_threads=task["workers"], cancellation_token=token, output_type=task["output"],
        )  # fmt: skip

    total = pycolmap.Reconstruction(model_dir).num_reg_images()
    run_with_progress(
        call, lambda: sum(map(Path.is_file, photos.rglob("*"))), "undistorting", total, ProgressReporter()
    )
    check_written(*(path for path in dense_dir.rglob("*") if path.is_file()))


# Fusion, Poisson meshing and simplification run on one thread: with more, the result depends on the order of the
# threads, and where cores are shared they are many times slower.


def fuse(task: FuseTask) -> None:
    """Fuse the depth maps of a dense workspace into points."""
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = task["min_views"]
    # our depths are checked already, and normals from disparities are noisier than those of COLMAP's PatchMatch
    options.max_normal_error = 25.0
    low, high = np.array(task["box"], np.float32)
    options.bounding_box = (low, high)
    options.use_cache = task["cache_gb"] > 0.0  # else all maps are in memory at once, which takes half the time
    options.cache_size = task["cache_gb"] or options.cache_size
    options.num_threads = 1
    pycolmap.stereo_fusion(Path(task["target"]), Path(task["dense"]), options=options, output_type="ply")
    check_written(Path(task["target"]))


def mesh_poisson(task: PoissonTask) -> None:
    """Span a closed surface over points (Poisson)."""
    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.trim = task["depth"], 0.0
    options.color = False  # it takes a tenth of the time, and the photos have better ones
    options.num_threads = 1
    pycolmap.poisson_meshing(Path(task["points"]), Path(task["target"]), options=options)
    check_written(Path(task["target"]))


def simplify(task: SimplifyTask) -> None:
    """Simplify a surface as far as its error allows, and then to at most the given number of triangles."""
    options = pycolmap.MeshSimplificationOptions()
    options.boundary_weight, options.num_threads = 10.0, task["threads"]
    source, target = Path(task["mesh"]), Path(task["target"])
    faces = count_faces(source)
    if task["max_error"]:
        options.target_face_ratio, options.max_error = 1.0 / faces, task["max_error"] ** 2
        pycolmap.simplify_mesh(source, target, options)
        source, faces = target, count_faces(target)
    if source != target or faces > task["most"]:
        options.target_face_ratio, options.max_error = min(task["most"] / faces, 1.0), 0.0
        pycolmap.simplify_mesh(source, target, options)
    check_written(target)


def count_faces(mesh: Path) -> int:
    """Return the number of triangles that the header of a PLY file states."""
    with mesh.open("rb") as file:
        return next(int(line.split()[2]) for line in file if line.startswith(b"element face"))


TASKS: dict[str, Callable[..., None]] = {
    "find_and_match": find_and_match,
    "match_chunk": match_chunk,
    "map_globally": map_globally,
    "map_with_defaults": map_with_defaults,
    "undistort": undistort,
    "fuse": fuse,
    "poisson": mesh_poisson,
    "simplify": simplify,
}

if __name__ == "__main__":
    serve(work)
