"""The surface in blocks: each is a task, and they are joined along their faces.

A block reads the fused points in and around it and the depth maps, and writes its surface into a file; a killed run
resumes at the missing blocks.
"""

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.dense import read_depth
from sfm_app.colmap.surface import positions, simplify
from sfm_app.errors import ReconstructionError
from sfm_app.files import fingerprint, load_arrays, mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.geometry.triangles import Clusters, median_edge_length, select_faces
from sfm_app.meshing.blocks import Partition, Split, close_cracks, split_points, weld
from sfm_app.meshing.cleaning import drop_islands, make_manifold
from sfm_app.meshing.tetrahedra import Cloud, thin
from sfm_app.operating_system import move
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.cost_estimate import block_count, block_workers
from sfm_app.settings import MeshSettings
from sfm_app.stereo import View
from sfm_app.surface.refining import FineShape, Originals, Partners, rank_partners, refine_surface, save_fine
from sfm_app.surface.spanning import Evidence, gather, span
from sfm_app.tasks import Task
from sfm_app.types import Surface
from sfm_app.types.arrays import FloatArray

POINTS = "points"
"""Folder with one file of records per block: no block reads the points of all."""
BLOCKS = "blocks"
"""Folder beside the surface while its blocks are made."""
CONTEXT = "context.npz"
"""File with few points of all blocks."""


@dataclass(frozen=True, slots=True)
class BlockOptions:
    """Limits of blocks."""

    chunk: int = 4_000_000
    """Points in memory while they are sorted. Chosen by hand."""
    sample: int = 4_000_000
    """Points that determine the blocks, at most twice as many. Chosen by hand."""
    halo: int = 24
    """Cells around a box to which the surface of its points reaches: gaps are closed in the same way from both sides.
    Chosen by hand."""
    context: float = 8.0
    """Distance of the points outside a block, in distances of those inside: lines of sight to them pass through the
    block. Chosen by hand."""
    weld_halo: float = 8.0
    """Cells from a plane over which a block is deformed to fit its neighbor. Chosen by hand."""
    crack: float = 2.0
    """Cells from a plane within which small holes are cracks of the weld. Chosen by hand."""


OPTIONS = BlockOptions()


@dataclass(frozen=True, slots=True, eq=False)
class BlockPoints:
    """The points of all blocks, in files."""

    folder: Path
    fields: np.dtype[np.void]
    """Fields of a record, as from `open_points`."""
    bounds: FloatArray
    """(B, 2, 3) lowest and highest coordinates of the points of each block."""

    def read(self, number: int) -> NDArray[np.void]:
        """Return the records of a block."""
        return np.fromfile(self.folder / str(number), self.fields)

    def read_box(self, box: FloatArray) -> NDArray[np.void]:
        """Return the records of all blocks that lie in a box; box (2, 3) lowest and highest coordinates."""
        overlaps = ((self.bounds[:, 0] <= box[1]) & (self.bounds[:, 1] >= box[0])).all(axis=1)
        parts = [np.empty(0, self.fields)]
        for number in np.flatnonzero(overlaps).tolist():
            records = self.read(number)
            place = positions(records)
            parts.append(records[((place >= box[0]) & (place <= box[1])).all(axis=1)])
        return np.concatenate(parts)


def sort_points(
    points: NDArray[np.void], partition: Partition, folder: Path, chunk: int = OPTIONS.chunk
) -> BlockPoints:
    """Write the records of points (N,), from `open_points`, into a file per block, unless a killed run has."""
    place, unfinished, count = folder / POINTS, folder / f"{POINTS}-unfinished", len(partition.boxes)
    if not place.exists():
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        for number in range(count):
            (unfinished / str(number)).touch()
        for start in range(0, len(points), chunk):
            part = np.asarray(points[start : start + chunk])
            numbers = partition.find_blocks(positions(part))
            ends = np.cumsum(np.bincount(numbers, minlength=count))
            for number, records in enumerate(np.split(part[np.argsort(numbers, kind="stable")], ends[:-1])):
                with (unfinished / str(number)).open("ab") as file:
                    file.write(records.tobytes())
        move(unfinished, place)
    blocks = BlockPoints(place, points.dtype, np.empty((count, 2, 3)))
    for number in range(count):
        own = positions(blocks.read(number))
        blocks.bounds[number] = own.min(axis=0, initial=np.inf), own.max(axis=0, initial=-np.inf)
    return blocks


def with_halo(bounds: FloatArray, cell: float) -> FloatArray:
    """Return (..., 2, 3) bounds with their halo; bounds (..., 2, 3) lowest and highest coordinates."""
    return bounds + OPTIONS.halo * cell * np.array([-1.0, 1.0])[:, None]


def simplify_mesh(surface: Surface, options: MeshSettings, scratch: Path, threads: int = 1) -> Surface:
    """Simplify to as few triangles as the error allows, and at most those of the settings."""
    if not options.max_error_edges and len(surface.faces) <= options.faces:
        return surface
    edge = median_edge_length(surface.vertices, surface.faces)
    return simplify(surface, options.faces, options.max_error_edges * edge, scratch, threads)


@dataclass(frozen=True, slots=True, eq=False)
class BlockTask:
    """Input of one block besides the files, for any process."""

    folder: Path
    points: BlockPoints
    dense_dir: Path
    originals: Originals
    views: Sequence[View]
    """Photos with the block in view."""
    partners: Partners
    """Photos with which each is compared."""
    number: int
    bounds: FloatArray
    """(2, 3) bounds of its points and halo."""
    options: MeshSettings
    tolerance: float
    """Relative difference in depth within which a photo confirms a vertex."""
    keeps_fine: bool
    """Whether its surface is also kept before simplification."""

    @property
    def path(self) -> Path:
        """The surface of the block."""
        return self.folder / f"{self.number}.npz"

    @property
    def fine_path(self) -> Path:
        """The surface of the block before it is simplified."""
        return self.folder / f"{self.number}-fine.npz"


def mesh_in_blocks(
    dense_dir: Path, originals: Originals, views: Sequence[View], points: NDArray[np.void], run: RunContext
) -> Surface:
    """Return the surface of all points, block by block."""
    options = run.settings.mesh
    folder = run.workspace.surface / BLOCKS
    made_from = fingerprint(run.fingerprint, len(points), options.model_dump())
    if not resume_or_clear(folder, made_from):
        mark_unfinished(folder, made_from)
    with run.step("sorting the points"):
        sample = np.asarray(points[:: max(1, len(points) // OPTIONS.sample)])
        partition = split_points(positions(sample), block_count(len(points), options))
        own = sort_points(points, partition, folder)
        cloud = gather(sample, views)
        cell = float(np.median(cloud.step))
        save_cloud(thin(cloud.points, cloud.normals, cloud.colors, OPTIONS.context * cloud.step), folder / CONTEXT)
    bounds = with_halo(own.bounds, cell)
    farthest = run.map(Task(farthest_depth, dense_dir), views, "measuring depths")
    partners = rank_partners(views)
    tasks = [
        BlockTask(folder, own, dense_dir, originals, near, {view.name: partners[view.name] for view in near},
                  k, bounds[k], options, run.settings.depth.consistency, run.settings.texture.normal_map)
        for k, near in enumerate(_photos_in_reach(views, farthest, bounds))
    ]  # fmt: skip
    with run.with_workers(block_workers(run.workers, run.memory_mb, options)) as few:
        raw = few.map(Task(mesh_block), tasks, "finding the surface in blocks")
    with run.step("joining the blocks"):
        joined, open_edges = join_blocks(partition.root, tasks, cell)
        joined = drop_islands(joined, options.min_island / len(tasks))  # a share of the triangles of a block
        surface = close_cracks(joined, partition.near_planes(joined.vertices, OPTIONS.crack * cell))
    if not len(surface.faces):
        raise ReconstructionError(
            "the photos confirm no part of the surface", hint="take more photos, a step apart, with more overlap"
        )
    run.record(blocks=len(tasks), planes=[list(plane) for plane in partition.planes()])
    run.record(cell=cell, raw_triangles=sum(raw), open_border_edges=open_edges)
    if run.settings.texture.normal_map:
        fine = ((task, FineShape.load(task.fine_path)) for task in tasks)
        parts = (  # each block without its halo, where its neighbors are better
            shape.select(partition.find_blocks(shape.vertices[shape.faces].mean(axis=1)) == task.number)
            for task, shape in fine
        )
        save_fine(parts, run.workspace.fine_surface)
    shutil.rmtree(folder)
    return surface


def mesh_block(task: BlockTask) -> int:
    """Write the surface of a block and its halo, unless a killed run has; return the number of its triangles."""
    if task.path.exists():
        return int(load_arrays(task.path)["raw"])
    # a worker that was cut off from a cluster may still be at the same block
    scratch = Path(tempfile.mkdtemp(dir=task.folder, prefix=f"{task.number}-"))
    evidence = Evidence(task.dense_dir, task.views, task.tolerance)
    near = gather(task.points.read_box(task.bounds), task.views)
    context = load_cloud(task.folder / CONTEXT, task.bounds)
    whole, witnesses = span(near, evidence, close=task.options.watertight, context=context)
    inside = ((whole.vertices >= task.bounds[0]) & (whole.vertices <= task.bounds[1])).all(axis=1)
    surface = select_faces(whole, inside[whole.faces].all(axis=1))
    raw = len(surface.faces)
    if raw and task.options.max_image_size_px:
        surface = refine_surface(surface, task.originals, witnesses, task.partners, task.options).surface
    if task.keeps_fine:
        save_fine([FineShape.from_surface(surface)], task.fine_path)
    if len(surface.faces):
        surface = make_manifold(simplify_mesh(surface, task.options, scratch))
    with replace_atomically(task.path) as path:
        np.savez(path, vertices=surface.vertices, faces=surface.faces, colors=surface.colors, raw=raw)
    shutil.rmtree(scratch)
    return raw


def save_cloud(cloud: Cloud, path: Path) -> None:
    """Write points atomically."""
    with replace_atomically(path) as beside:
        np.savez(beside, points=cloud.points, normals=cloud.normals, colors=cloud.colors, step=cloud.step)


def load_cloud(path: Path, bounds: FloatArray) -> Cloud:
    """Read the points outside bounds (2, 3)."""
    stored = load_arrays(path)
    cloud = Cloud(*(stored[name] for name in ("points", "normals", "colors", "step")))
    return cloud.select(((cloud.points < bounds[0]) | (cloud.points > bounds[1])).any(axis=1))


def join_blocks(node: Split | int, tasks: Sequence[BlockTask], cell: float) -> tuple[Surface, int]:
    """Return the joined surface of all blocks below a node, and the number of open edges at their faces."""
    if not isinstance(node, Split):
        stored = load_arrays(tasks[node].path)
        return Surface(stored["vertices"], stored["faces"], stored["colors"]), 0
    (low, low_edges), (high, high_edges) = (join_blocks(half, tasks, cell) for half in (node.low, node.high))
    joined, edges = weld(low, high, node.axis, node.at, cell, OPTIONS.weld_halo * cell)
    return joined, edges + low_edges + high_edges


def farthest_depth(dense_dir: Path, view: View) -> float:
    """Return the largest known depth of a photo; beyond, it is no evidence."""
    return float(read_depth(dense_dir, view, "geometric").max(initial=0.0))


def _photos_in_reach(views: Sequence[View], farthest: Sequence[float], bounds: FloatArray) -> list[list[View]]:
    """Return for each block the photos that have it in view, and not only behind all known depths."""
    centers = bounds.mean(axis=1)
    radii = 0.5 * np.linalg.norm(bounds[:, 1] - bounds[:, 0], axis=1)
    blocks = Clusters(np.arange(len(bounds)), np.arange(len(bounds) + 1), centers, radii)
    near: list[list[View]] = [[] for _ in bounds]
    for view, far in zip(views, farthest, strict=True):
        for number in blocks.find_in_cone(view.center, view.axis, view.widest_angle):
            if (centers[number] - view.center) @ view.axis - radii[number] <= far:
                near[number].append(view.bare)
    return near
