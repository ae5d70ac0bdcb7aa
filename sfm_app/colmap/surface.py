"""COLMAP's fusion of depth maps, and mesh simplification."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap import tasks
from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.worker_process import run_worker
from sfm_app.jit import kernel
from sfm_app.types import Surface
from sfm_app.types.arrays import ByteArray, FloatArray, IndexArray

FUSED = "fused.ply"


def fuse(dense_dir: Path, target: Path, cache_gb: float = 0.0) -> IndexArray:
    """Fuse the geometric maps of a dense workspace into the PLY file `target`; return (N,) photos of each point.

    The cache of maps has `cache_gb`: the less, the more often they are read. 0 holds all, in half the time.
    """
    run_worker(partial(tasks.fuse, dense_dir, target, cache_gb), "fusing depth maps")
    lists = target.with_name(f"{target.name}.vis")  # the number of points; for each, the number of photos and these
    with translate_errors(f"reading {lists.name}"):
        seen = np.zeros(int(np.fromfile(lists, "<u8", 1)[0]), np.int64)
        _count_photos(np.fromfile(lists, "<u4", offset=8), seen)
    lists.unlink()
    return seen


@kernel
def _count_photos(lists: NDArray[np.uint32], seen: IndexArray) -> None:
    at = 0
    for point in range(len(seen)):
        seen[point] = lists[at]
        at += 1 + seen[point]


def open_points(path: Path) -> NDArray[np.void]:
    """Return the records (N,) of COLMAP's points, with fields x, y, z, nx, ..., mapped from the file."""
    with translate_errors(f"reading {path.name}"), path.open("rb") as file:
        count, fields = -1, list[tuple[str, str]]()
        while (words := file.readline().split()) != [b"end_header"]:
            if not words:
                raise ValueError(f"the header of {path} has no end")
            if words[:2] == [b"element", b"vertex"]:
                count = int(words[2])
            elif words[0] == b"property":
                fields.append((words[2].decode("ascii"), {b"float": "<f4", b"uchar": "u1"}[words[1]]))
        start = file.tell()
        if count < 1:
            return np.empty(0, fields)
        return np.memmap(path, np.dtype(fields), "r", start, (count,))


def write_points(parts: Sequence[NDArray[np.void]], path: Path) -> None:
    """Write records (N,) of the same fields, as of `open_points`, one after the other as a PLY file."""
    with path.open("wb") as file:
        file.write(_header(parts[0].dtype, sum(map(len, parts))))
        for part in parts:
            file.write(np.ascontiguousarray(part).tobytes())


def _header(fields: np.dtype[np.void], count: int) -> bytes:
    kinds = {"f": "float", "u": "uchar"}
    properties = [f"property {kinds[kind[0].kind]} {name}" for name, kind in (fields.fields or {}).items()]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header", ""]
    return "\n".join(lines).encode("ascii")


def positions(records: NDArray[np.void]) -> FloatArray:
    """Return the positions (N, 3) of records."""
    return np.stack([records[c] for c in "xyz"], axis=1).astype(np.float64)


def simplify(surface: Surface, most: int, max_error: float, scratch: Path, threads: int = 1) -> Surface:
    """Collapse edges, cheapest first by their quadric error (Garland and Heckbert, SIGGRAPH 1997), of a manifold.

    Each vertex has the mean color of the vertices that it replaces; borders are kept. Edges collapse down to `most`
    triangles, and further while the root of the summed squared distances from the replaced planes is `max_error`.
    """
    import trimesh

    fine, coarse = scratch / "fine.ply", scratch / "coarse.ply"
    trimesh.Trimesh(surface.vertices, surface.faces, process=False).export(fine)
    run_worker(partial(tasks.simplify, fine, coarse, most, max_error, threads), "simplifying the surface")
    simple = _read(coarse)
    fine.unlink()
    coarse.unlink()
    return Surface(simple.vertices, simple.faces, _mean_colors(surface, simple.vertices, threads))


def _mean_colors(surface: Surface, vertices: FloatArray, threads: int) -> ByteArray:
    """Return mean colors (V, 3) of the old vertices nearest to each new vertex (V, 3); pycolmap 4.2 reads no colors."""
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(vertices).query(surface.vertices, workers=threads)
    count = np.bincount(nearest, minlength=len(vertices))
    total = np.stack([np.bincount(nearest, channel, len(vertices)) for channel in surface.colors.T], axis=1)
    mean = np.rint(total / np.maximum(count, 1)[:, None]).astype(np.uint8)
    alone = np.flatnonzero(count == 0)
    mean[alone] = surface.colors[cKDTree(surface.vertices).query(vertices[alone])[1]]
    return mean


def _read(path: Path) -> Surface:
    import trimesh

    mesh = trimesh.load(path, process=False)
    if not isinstance(mesh, trimesh.Trimesh):  # a file without triangles
        return Surface(np.empty((0, 3)), np.empty((0, 3), np.int64), np.empty((0, 3), np.uint8))
    return Surface(
        np.asarray(mesh.vertices, np.float64),
        np.asarray(mesh.faces, np.int64),
        np.asarray(mesh.visual.vertex_colors, np.uint8)[:, :3],
    )
