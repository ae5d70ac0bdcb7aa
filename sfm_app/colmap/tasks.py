"""Calls of COLMAP in its worker processes, see `worker_process`: no module here loads an estimator."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from sfm_app.colmap.backend import check_written, largest_model, pycolmap, run_with_progress
from sfm_app.colmap.worker_process import ProgressReporter

MAX_FOCAL_RATIO = 10.0
"""Largest change of a focal, as a factor: the limit of COLMAP's incremental mapper. By definition."""
JPEG_QUALITY = 98
UNDISTORTED_PHOTOS = {"COLMAP": "images", "PMVS": "pmvs/visualize"}
"""Folder of the undistorted photos, by layout."""


def map_globally(scratch: Path, photo_dir: Path, seed: int, names: Sequence[str]) -> None:
    """Run COLMAP's global mapper, and write the largest model into `model` in the scratch folder."""
    (scratch / "all").mkdir()
    options = global_options(seed, names)
    models = pycolmap.global_mapping(scratch / "database.db", photo_dir, scratch / "all", options)
    database = pycolmap.Database.open(scratch / "database.db")
    before = {camera.camera_id: camera for camera in database.read_all_cameras()}
    database.close()
    for model in models.values():
        remove_runaways(model, before)
    _write_largest(models, scratch / "model")


def remove_runaways(model: pycolmap.Reconstruction, before: Mapping[int, pycolmap.Camera]) -> None:
    """Remove photos whose focal has changed without bounds, which COLMAP's global mapper does not check."""
    images: Iterable[pycolmap.Image] = list(model.images.values())
    frames = set[int]()
    for image in images:
        now, then = (cameras[image.camera_id] for cameras in (model.cameras, before))
        ratios = [now.params[k] / then.params[k] for k in now.focal_length_idxs()]
        if image.has_pose and not all(1.0 / MAX_FOCAL_RATIO < ratio < MAX_FOCAL_RATIO for ratio in ratios):
            frames.add(image.frame_id)
    for frame in sorted(frames):
        model.deregister_frame(frame)
    if frames:
        model.tear_down()


def global_options(seed: int, names: Sequence[str]) -> pycolmap.GlobalPipelineOptions:
    """Return COLMAP's defaults, except that it uses our relative poses unchanged and adjusts coarsely."""
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


def map_with_defaults(scratch: Path, photo_dir: Path, seed: int) -> None:
    """Verify and map raw matches with COLMAP's defaults but seeds and one thread; write the largest model."""
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
    models = pycolmap.incremental_mapping(database, photo_dir, scratch / "all", options)
    _write_largest(models, scratch / "model")


def _write_largest(models: Mapping[int, pycolmap.Reconstruction], folder: Path) -> None:
    model = largest_model(models)
    if model is not None:
        folder.mkdir()
        model.write(folder)
        check_written(*folder.iterdir())


def undistort(
    dense_dir: Path, model_dir: Path, photo_dir: Path, max_side_px: int, workers: int, layout: str = "COLMAP"
) -> None:
    """Write undistorted photos and their model into a dense workspace, whose layout is "COLMAP" or "PMVS".

    COLMAP's JPEG writer ends the process when the disk is full.
    """
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = max_side_px
    photos = dense_dir / UNDISTORTED_PHOTOS[layout]

    def call(token: pycolmap.CancellationToken) -> None:
        pycolmap.undistort_images(
            dense_dir, model_dir, photo_dir, undistort_options=options, jpeg_quality=JPEG_QUALITY,
            num_threads=workers, cancellation_token=token, output_type=layout,
        )  # fmt: skip

    total = pycolmap.Reconstruction(model_dir).num_reg_images()
    run_with_progress(
        call, lambda: sum(map(Path.is_file, photos.rglob("*"))), "undistorting", total, ProgressReporter()
    )
    check_written(*(path for path in dense_dir.rglob("*") if path.is_file()))


# Fusion and simplification run on one thread: with more, the result depends on the order of the
# threads, and where cores are shared they are many times slower.


def fuse(dense_dir: Path, target: Path, cache_gb: float) -> None:
    """Fuse the depth maps of a dense workspace into points, also those of one photo."""
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = 1
    # our depths are checked already, and normals from disparities are noisier than those of COLMAP's PatchMatch
    options.max_normal_error = 25.0
    options.use_cache = cache_gb > 0.0  # else all maps are in memory at once, which takes half the time
    options.cache_size = cache_gb or options.cache_size
    options.num_threads = 1
    pycolmap.stereo_fusion(target, dense_dir, options=options, output_type="ply")
    check_written(target)


def simplify(mesh: Path, target: Path, most: int, max_error: float, threads: int) -> None:
    """Simplify a surface as far as its error allows, and then to at most the given number of triangles."""
    options = pycolmap.MeshSimplificationOptions()
    options.boundary_weight, options.num_threads = 10.0, threads
    faces = count_faces(mesh)
    if max_error:
        options.target_face_ratio, options.max_error = 1.0 / faces, max_error**2
        pycolmap.simplify_mesh(mesh, target, options)
        mesh, faces = target, count_faces(target)
    if mesh != target or faces > most:
        options.target_face_ratio, options.max_error = min(most / faces, 1.0), 0.0
        pycolmap.simplify_mesh(mesh, target, options)
    check_written(target)


def count_faces(mesh: Path) -> int:
    """Return the number of triangles that the header of a PLY file states."""
    with mesh.open("rb") as file:
        return next(int(line.split()[2]) for line in file if line.startswith(b"element face"))
