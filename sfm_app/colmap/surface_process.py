"""COLMAP's fusion, Poisson meshing and simplification; see `surface.py`. Only a separate process can be stopped.

All run on one thread: with more, the result depends on the order of the threads, and where cores are shared they are
many times slower.
"""

from pathlib import Path

import numpy as np

from sfm_app.colmap.backend import check_written, pycolmap
from sfm_app.colmap.worker_process import FuseTask, PoissonTask, SimplifyTask, serve

MAX_NORMAL_ERROR_DEG = 25.0
BORDER_WEIGHT = 10.0
"""Weight of the error at a border, relative to the error of the surface."""


def work(task: FuseTask | PoissonTask | SimplifyTask) -> None:
    """Do the task that its entry `do` names."""
    if task["do"] == "fuse":
        fuse(task)
    elif task["do"] == "poisson":
        mesh_poisson(task)
    else:
        simplify(task)
    check_written(Path(task["target"]))


def fuse(task: FuseTask) -> None:
    """Fuse the depth maps of a dense workspace into points."""
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = task["min_views"]
    # The depths have been checked before; normals from disparities are noisier than those of COLMAP's PatchMatch.
    options.max_normal_error = MAX_NORMAL_ERROR_DEG
    low, high = np.array(task["box"], np.float32)
    options.bounding_box = (low, high)
    options.use_cache = task["cache_gb"] > 0.0  # else all maps are in memory at once, which takes half the time
    options.cache_size = task["cache_gb"] or options.cache_size
    options.num_threads = 1
    pycolmap.stereo_fusion(Path(task["target"]), Path(task["dense"]), options=options, output_type="ply")


def mesh_poisson(task: PoissonTask) -> None:
    """Span a closed surface over points (Poisson)."""
    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.trim = task["depth"], 0.0
    options.color = False  # it takes a tenth of the time, and the photos have better ones
    options.num_threads = 1
    pycolmap.poisson_meshing(Path(task["points"]), Path(task["target"]), options=options)


def simplify(task: SimplifyTask) -> None:
    """Simplify a surface as far as its error allows, and then to as few triangles as are asked for."""
    options = pycolmap.MeshSimplificationOptions()
    options.boundary_weight, options.num_threads = BORDER_WEIGHT, task["threads"]
    source, target = Path(task["mesh"]), Path(task["target"])
    faces = count_faces(source)
    if task["max_error"]:
        options.target_face_ratio, options.max_error = 1.0 / faces, task["max_error"] ** 2
        pycolmap.simplify_mesh(source, target, options)
        source, faces = target, count_faces(target)
    if source != target or faces > task["most"]:
        options.target_face_ratio, options.max_error = min(task["most"] / faces, 1.0), 0.0
        pycolmap.simplify_mesh(source, target, options)


def count_faces(mesh: Path) -> int:
    """Return the number of triangles that the header of a PLY file states."""
    with mesh.open("rb") as file:
        return next(int(line.split()[2]) for line in file if line.startswith(b"element face"))


if __name__ == "__main__":
    serve(work)
