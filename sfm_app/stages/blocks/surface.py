"""The surface in blocks: each is a task of its own, and they are joined along their faces.

A block reads the fused points in and around it and the depth maps, and writes its surface into a file; a killed run
resumes at the blocks that are missing.
"""

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.atomic_io import mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.colmap.dense import read_depth
from sfm_app.colmap.surface import positions
from sfm_app.errors import ReconstructionError
from sfm_app.geometry.culling import Clusters, border_angle
from sfm_app.hashing import fingerprint, load_arrays
from sfm_app.meshing import drop_islands, make_manifold, trim
from sfm_app.meshing.blocks.partition import Partition, Split, split_points
from sfm_app.meshing.blocks.weld import close_cracks, weld
from sfm_app.meshing.octree import DEEPEST, Cube, cell_sizes, choose_cell, cube_around
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.cost_estimate import block_count, block_workers
from sfm_app.settings import MeshSettings
from sfm_app.stages.blocks.fine import FineShape, save_fine
from sfm_app.stages.blocks.judging import SurfaceJudge, judge_by_all, simplify_mesh
from sfm_app.stages.blocks.points import BlockPoints, sort_points
from sfm_app.stages.blocks.poisson import RecordCells, span_surface, with_halo
from sfm_app.stages.blocks.refining import Originals, Partners, rank_partners, refine_surface
from sfm_app.stereo import View
from sfm_app.tasks import Task
from sfm_app.types import Surface

FloatArray = NDArray[np.float64]

BLOCKS = "blocks"
"""Folder beside the surface while its blocks are made."""
GIVE_WAY = 8.0
"""Cells over which a block gives way to its neighbor. Chosen by hand."""
AT_PLANE = 2.0
"""Cells from a plane within which small holes are cracks from joining. Chosen by hand."""
SAMPLE = 4_000_000
"""Points, at most twice as many, by which the blocks are laid out."""


@dataclass(frozen=True, slots=True, eq=False)
class BlockTask:
    """Everything that one block needs besides the files; it can be sent to another process."""

    folder: Path
    """Where its files go."""
    points: BlockPoints
    """Those of all blocks."""
    dense_dir: Path
    originals: Originals
    views: Sequence[View]
    """The photos that may see it."""
    partners: Partners
    """With which of the others each one is compared."""
    number: int
    bounds: FloatArray
    """(2, 3) of its points and halo."""
    cell: float
    """Side of the finest cells."""
    cube: Cube
    options: MeshSettings
    tolerance: float
    """Relative difference in depth within which a photo confirms a vertex."""
    least: float
    """Photos that have to confirm the average vertex of a part."""
    keeps_fine: bool
    """Whether its surface is also kept as it is before it is simplified."""

    @property
    def path(self) -> Path:
        """The surface of the block."""
        return self.folder / f"{self.number}.npz"

    @property
    def fine_path(self) -> Path:
        """The surface of the block before it is simplified."""
        return self.folder / f"{self.number}-fine.npz"


def mesh_in_blocks(
    source: tuple[Path, Originals], views: Sequence[View], points: NDArray[np.void], least: float, run: RunContext
) -> Surface:
    """Return the surface of all points, made block by block.

    Args:
        source: dense workspace with depth maps, and the photos.
        views: photos with a depth map.
        points: (N,) records of the fused points.
        least: photos that have to confirm the average vertex of a part.
        run: the run.

    Raises:
        ReconstructionError: there is no surface.
    """
    (dense_dir, originals), place, options = source, run.workspace.surface, run.settings.mesh
    folder = place / BLOCKS
    made_from = fingerprint(run.fingerprint, len(points), options.model_dump())
    if not resume_or_clear(folder, made_from):
        mark_unfinished(folder, made_from)
    with run.step("sorting the points"):
        partition = split_points(_sample(points), block_count(len(points), options))
        own = sort_points(points, partition, folder)
        sizes = sizes_for_blocks(own.bounds, options.poisson_depth)
        cell = choose_cell(sizes, RecordCells(lambda: map(own.read, range(len(own.bounds)))))
    bounds = with_halo(own.bounds, cell)
    cubes = [cube_around(low, high, cell) for low, high in bounds]
    farthest = run.map(Task(farthest_depth, dense_dir), views, "measuring depths")
    partners = rank_partners(views)
    seers = _photos_in_reach(views, farthest, bounds)
    tasks = [
        BlockTask(folder, own, dense_dir, originals, seen, {view.name: partners[view.name] for view in seen},
                  k, bounds[k], cell, cubes[k], options, run.settings.depth.consistency, least,
                  run.settings.texture.normal_map)
        for k, seen in enumerate(seers)
    ]  # fmt: skip
    with run.with_workers(block_workers(run.workers, run.memory_mb, options)) as few:
        raw = few.map(Task(mesh_block), tasks, "finding the surface in blocks")
    with run.step("joining the blocks"):
        joined, lost = join_blocks(partition.root, tasks, cell)
        joined = drop_islands(joined, options.min_island / len(tasks))  # a share of the triangles of a block
        surface = close_cracks(joined, partition.near_planes(joined.vertices, AT_PLANE * cell))
    if not len(surface.faces):
        raise ReconstructionError(
            "the photos confirm no part of the surface", hint="take more photos, a step apart, with more overlap"
        )
    run.record(blocks=len(tasks), planes=[list(plane) for plane in partition.planes()])
    run.record(cell=cell, raw_triangles=sum(raw), open_border_edges=lost)
    if run.settings.texture.normal_map:
        save_fine(_parts_without_halo(tasks, partition), run.workspace.fine_surface)
    shutil.rmtree(folder)
    return surface


def mesh_block(task: BlockTask) -> int:
    """Write the surface of a block and its halo, unless a killed run has; return the triangles that Poisson found."""
    if task.path.exists():
        return int(load_arrays(task.path)["raw"])
    # a worker that was cut off from a cluster may still be at the same block
    scratch = Path(tempfile.mkdtemp(dir=task.folder, prefix=f"{task.number}-"))
    near, raw = span_surface(task.points.read_box(task.bounds), task.bounds, task.cube, scratch)
    judge = SurfaceJudge.prepare(near, task.dense_dir, task.tolerance)
    found, support, seers = judge_by_all(judge, task.views)
    if task.options.trim and len(found.faces):
        found = trim(found, support, task.options.max_gap_triangles, task.least)
    if len(found.faces) and task.options.max_image_size_px:
        found = refine_surface(found, task.originals, seers, task.partners, task.options).surface
    found = _simplify_block(found, task, scratch)
    with replace_atomically(task.path) as path:
        np.savez(path, vertices=found.vertices, faces=found.faces, colors=found.colors, raw=raw)
    shutil.rmtree(scratch)
    return raw


def _simplify_block(found: Surface, task: BlockTask, scratch: Path) -> Surface:
    """Return the surface of a block with few triangles, and keep it as it is where a normal map is made of it."""
    if task.keeps_fine:
        save_fine([FineShape.from_surface(found)], task.fine_path)
    return make_manifold(simplify_mesh(found, task.options, scratch)) if len(found.faces) else found


def _parts_without_halo(tasks: Sequence[BlockTask], partition: Partition) -> Iterator[FineShape]:
    """Yield the fine surface of each block without its halo, which the neighbors have, too, and better."""
    for task in tasks:
        fine = FineShape.load(task.fine_path)
        yield fine.select(partition.find_blocks(fine.vertices[fine.faces].mean(axis=1)) == task.number)


def join_blocks(node: Split | int, tasks: Sequence[BlockTask], cell: float) -> tuple[Surface, int]:
    """Return the joined surface of all blocks below a node, and how many edges at their faces stayed open.

    Args:
        node: of the partition.
        tasks: the blocks, all written.
        cell: side of the finest cells.
    """
    if not isinstance(node, Split):
        stored = load_arrays(tasks[node].path)
        return Surface(stored["vertices"], stored["faces"], stored["colors"]), 0
    (low, lost), (high, also) = (join_blocks(half, tasks, cell) for half in (node.low, node.high))
    joined, here = weld(low, high, node.axis, node.at, cell, GIVE_WAY * cell)
    return joined, here + lost + also


def sizes_for_blocks(bounds: FloatArray, most: int) -> list[float]:
    """Return sides of cells for which no octree of a block is too deep, the finest first.

    Args:
        bounds: (B, 2, 3) of the points of each block.
        most: greatest depth of a block's octree.
    """
    extent = float((bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)).max())

    def deepest(cell: float) -> int:
        return max(cube_around(low, high, cell).depth for low, high in with_halo(bounds, cell))

    sizes = list(cell_sizes(extent, DEEPEST))
    return [cell for cell in sizes if deepest(cell) <= most] or sizes[-1:]


def farthest_depth(dense_dir: Path, view: View) -> float:
    """Return the largest depth that the map of a photo knows; beyond, it is no evidence.

    Args:
        dense_dir: folder with undistorted photos and their maps.
        view: a photo with a map.
    """
    return float(read_depth(dense_dir, view, "geometric").max(initial=0.0))


def _sample(points: NDArray[np.void]) -> FloatArray:
    return positions(points[:: max(1, len(points) // SAMPLE)])


def _photos_in_reach(views: Sequence[View], farthest: Sequence[float], bounds: FloatArray) -> list[list[View]]:
    """Return for each block the photos that have it in view, and not only behind all that they know."""
    centers = bounds.mean(axis=1)
    radii = 0.5 * np.linalg.norm(bounds[:, 1] - bounds[:, 0], axis=1)
    blocks = Clusters(np.arange(len(bounds)), np.arange(len(bounds) + 1), centers, radii)
    found: list[list[View]] = [[] for _ in bounds]
    for view, far in zip(views, farthest, strict=True):
        bare = replace(view, point_ids=np.empty(0, np.int64), points=np.empty((0, 3)))
        for number in blocks.find_in_cone(view.center, view.R[2], border_angle(view.K, view.width, view.height)):
            if (centers[number] - view.center) @ view.R[2] - radii[number] <= far:
                found[number].append(bare)
    return found
