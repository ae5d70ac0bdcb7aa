"""COLMAP's own pipeline on our matches, as a separate process; see `mapping.map_with_colmap_defaults`."""

from pathlib import Path

from sfm_app.colmap.backend import check_written, pycolmap
from sfm_app.colmap.mapping import largest_model
from sfm_app.colmap.worker_process import MappingTask, serve


def work(task: MappingTask) -> None:
    """Verify the raw matches, map them with COLMAP's defaults, and write the largest model into `model`.

    Only seeds and the number of threads differ from the defaults: on several threads, results differ between runs.
    """
    scratch, seed = Path(task["scratch"]), task["seed"]
    database = scratch / "database.db"
    _verify(database, seed)
    (scratch / "all").mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    model = largest_model(pycolmap.incremental_mapping(database, Path(task["photos"]), scratch / "all", options))
    if model is not None:
        (scratch / "model").mkdir()
        model.write(scratch / "model")
        check_written(*(scratch / "model").iterdir())


def _verify(database: Path, seed: int) -> None:
    """Replace all two-view geometries by those of COLMAP's geometric verification of the raw matches."""
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = seed
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = 1
    pycolmap.geometric_verification(database, verifier, two_view_geometry_options=geometry)


if __name__ == "__main__":
    serve(work)
