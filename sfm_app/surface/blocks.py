"""The surface in blocks: each is a task of its own, and they are joined along their faces.

A block reads the fused points in and around it and the depth maps, and writes its surface into a file; a killed run
resumes at the blocks that are missing.
"""

import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.dense import read_color, read_depth
from sfm_app.colmap.surface import FUSED, poisson_surface, positions, simplify, write_points
from sfm_app.errors import ReconstructionError
from sfm_app.files import fingerprint, load_arrays, mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.geometry.triangles import Clusters, border_angle, cluster, median_edge_length, select_faces, vertex_normals
from sfm_app.meshing import (
    CONFIRMED,
    NO_EVIDENCE,
    DepthView,
    Paint,
    Support,
    drop_islands,
    judge,
    make_manifold,
    sample_colors,
    trim,
)
from sfm_app.meshing.blocks import Partition, Split, close_cracks, split_points, weld
from sfm_app.meshing.octree import DEEPEST, Cube, cell_sizes, choose_cell, count_bent, count_cells, cube_around
from sfm_app.operating_system import move
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.cost_estimate import block_count, block_workers
from sfm_app.settings import MeshSettings
from sfm_app.stereo import View
from sfm_app.surface.refining import FineShape, Originals, Partners, rank_partners, refine_surface, save_fine
from sfm_app.tasks import Shared, Task
from sfm_app.types import Surface
from sfm_app.types.arrays import FloatArray

# The fused points sorted by blocks: each block's are in a file of its own, so that no block reads those of all.

POINTS = "points"
"""Folder with one file of records per block."""
CHUNK = 4_000_000
"""Points that are read at once."""


@dataclass(frozen=True, slots=True, eq=False)
class BlockPoints:
    """The points of all blocks, in files."""

    folder: Path
    fields: np.dtype[np.void]
    """Of a record, as `open_points` has it."""
    bounds: FloatArray
    """(B, 2, 3) lowest and highest coordinates of the points of each block."""

    def read(self, number: int) -> NDArray[np.void]:
        """Return the records of a block."""
        return np.fromfile(self.folder / str(number), self.fields)

    def read_box(self, box: FloatArray) -> NDArray[np.void]:
        """Return the records of all blocks that lie in a box.

        Args:
            box: (2, 3) lowest and highest coordinates.
        """
        meet = ((self.bounds[:, 0] <= box[1]) & (self.bounds[:, 1] >= box[0])).all(axis=1)
        parts = [np.empty(0, self.fields)]
        for number in np.flatnonzero(meet).tolist():
            records = self.read(number)
            where = positions(records)
            parts.append(records[((where >= box[0]) & (where <= box[1])).all(axis=1)])
        return np.concatenate(parts)


def sort_points(points: NDArray[np.void], partition: Partition, folder: Path) -> BlockPoints:
    """Write the points of each block into a file, unless a killed run has.

    Args:
        points: (N,) records of all points, as `open_points` has them.
    """
    place, unfinished, count = folder / POINTS, folder / f"{POINTS}-unfinished", len(partition.boxes)
    if not place.exists():
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        for number in range(count):
            (unfinished / str(number)).touch()
        for start in range(0, len(points), CHUNK):
            chunk = np.asarray(points[start : start + CHUNK])
            _add(chunk, partition.find_blocks(positions(chunk)), unfinished, count)
        move(unfinished, place)
    found = BlockPoints(place, points.dtype, np.empty((count, 2, 3)))
    for number in range(count):
        where = positions(found.read(number))
        found.bounds[number] = where.min(axis=0, initial=np.inf), where.max(axis=0, initial=-np.inf)
    return found


def _add(records: NDArray[np.void], numbers: NDArray[np.intp], folder: Path, count: int) -> None:
    """Add records to the files of their blocks, in their order."""
    ends = np.cumsum(np.bincount(numbers, minlength=count))
    parts: Sequence[NDArray[np.void]] = np.split(records[np.argsort(numbers, kind="stable")], ends[:-1])
    for number, part in enumerate(parts):
        with (folder / str(number)).open("ab") as file:
            file.write(part.tobytes())


# Poisson's surface of points, in a cube that two more points enlarge until its cells have the size asked for.

HALO = 24
"""Cells around a box to which the surface of its points reaches. Gaps of twenty triangles are closed in the same way
from both sides of a block, and Poisson's surface no longer depends on where the points end. Chosen by hand."""
EVERYWHERE = np.array([[-np.inf] * 3, [np.inf] * 3])
"""Bounds without end."""


@dataclass(frozen=True, slots=True)
class RecordCells:
    """The `PointCells` of the fused points, which may be too many to be held at once."""

    read: Callable[[], Iterable[NDArray[np.void]]]
    """Gives their records, part by part."""

    def points_per_cell(self, cell: float) -> float:
        """Return the mean number of points in an occupied cell."""
        counts = [(len(part), count_cells(positions(part), cell)) for part in self.read()]
        points, occupied = np.sum(counts, axis=0)
        return float(points / occupied)

    def bent_share(self, cell: float) -> float:
        """Return the share of cells whose normals differ."""
        counts = [count_bent(positions(part), _normals(part), cell) for part in self.read()]
        bent, told = np.sum(counts, axis=0)
        return float(bent / max(told, 1))


def _normals(records: NDArray[np.void]) -> FloatArray:
    """Return the normals (N, 3) of records."""
    return np.stack([records[f"n{c}"] for c in "xyz"], axis=1).astype(np.float64)


def with_halo(bounds: FloatArray, cell: float) -> FloatArray:
    """Return (..., 2, 3) bounds with their halo.

    Args:
        bounds: (..., 2, 3) lowest and highest coordinates.
    """
    return bounds + HALO * cell * np.array([-1.0, 1.0])[:, None]


def span_surface(records: NDArray[np.void], bounds: FloatArray, cube: Cube, place: Path) -> tuple[Surface, int]:
    """Return Poisson's surface within bounds, and how many triangles all of it has.

    Args:
        records: (N,) of the points, as `open_points` has them.
        bounds: (2, 3) lowest and highest coordinates.
    """
    anchors = np.zeros(2, records.dtype)
    for axis, letter in enumerate("xyz"):
        anchors[letter] = cube.anchors[:, axis]
        anchors[f"n{letter}"] = 3.0**-0.5
    with tempfile.TemporaryDirectory(dir=place, prefix="poisson-") as scratch:
        write_points(np.concatenate([anchors, records]), Path(scratch) / FUSED)
        raw = poisson_surface(Path(scratch), cube.depth)
    inside = ((raw.vertices >= bounds[0]) & (raw.vertices <= bounds[1])).all(axis=1)
    return select_faces(raw, inside[raw.faces].all(axis=1)), len(raw.faces)


# What the surface at once and the surface in blocks have in common: the photos' judgment, and simplification.

LEAST_CONFIRMED = 200
"""Vertices of a block that a photo has to confirm for taking part in its refinement. Chosen by hand."""

Judgment = tuple[NDArray[np.int64], NDArray[np.uint8], Paint]
"""Of one photo: the vertices (N,) it says something about, what it says of each (N,), and its colors there."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceJudge:
    """Asks photos whether they confirm the vertices of a surface, and for their colors."""

    surface: Surface
    normals: NDArray[np.float64]
    """(V, 3)"""
    clusters: Clusters
    """Of the vertices."""
    dense_dir: Path
    """Folder with undistorted photos and their maps."""
    tolerance: float
    """Relative difference in depth."""

    @classmethod
    def prepare(cls, surface: Surface, dense_dir: Path, tolerance: float) -> "SurfaceJudge":
        """Prepare for a surface from Poisson reconstruction.

        Args:
            tolerance: relative difference in depth within which a photo confirms a vertex.
        """
        normals = vertex_normals(surface.vertices, surface.faces)
        return cls(surface, normals, cluster(surface.vertices[:, None, :]), dense_dir, tolerance)

    def judge(self, view: View) -> Judgment:
        """Let one photo judge the vertices that it has in view."""
        eye = DepthView(view.K, view.R, view.t, read_depth(self.dense_dir, view, "geometric"), view.sample_px)
        near = self.clusters.find_in_cone(eye.center, eye.axis, eye.widest_angle)
        points, normals = self.surface.vertices[near], self.normals[near]
        verdict = judge(points, normals, eye, self.tolerance)
        paint = sample_colors(points, normals, verdict, eye, read_color(self.dense_dir, view))
        said = verdict != NO_EVIDENCE
        return near[said], verdict[said], Paint(paint.total[said], paint.weight[said])

    def sum_up(self, judgments: Iterable[Judgment]) -> tuple[Surface, Support]:
        """Return the surface with colors from the photos, and their support for each of its vertices."""
        support, paint = Support.zeros(len(self.normals)), Paint.zeros(len(self.normals))
        for at, verdict, colors in judgments:
            support.add(at, verdict)
            paint.add(at, colors)
        surface = self.surface
        return Surface(surface.vertices, surface.faces, paint.mean_colors(surface.vertices)), support


def judge_by_all(judge: SurfaceJudge, views: Sequence[View]) -> tuple[Surface, Support, list[View]]:
    """Return what `sum_up` does, and the photos that confirm enough of the surface to refine it."""
    seers = list[View]()

    def ask(view: View) -> Judgment:
        said = judge.judge(view)
        if np.count_nonzero(said[1] == CONFIRMED) >= LEAST_CONFIRMED:
            seers.append(view)
        return said

    return *judge.sum_up(map(ask, views)), seers


def judge_view(judges: Shared[SurfaceJudge], view: View) -> Judgment:
    """Let one photo judge the vertices that it has in view, on any machine."""
    return judges.value.judge(view)


def simplify_mesh(surface: Surface, options: MeshSettings, scratch: Path, threads: int = 1) -> Surface:
    """Simplify to as few triangles as the error allows, and no more than asked for."""
    if not options.max_error_edges and len(surface.faces) <= options.faces:
        return surface
    edge = median_edge_length(surface.vertices, surface.faces)
    return simplify(surface, options.faces, options.max_error_edges * edge, scratch, threads)


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
        points: (N,) records of the fused points.

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
    """Return the joined surface of all blocks below a node, and how many edges at their faces stayed open."""
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
    """
    extent = float((bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)).max())

    def deepest(cell: float) -> int:
        return max(cube_around(low, high, cell).depth for low, high in with_halo(bounds, cell))

    sizes = list(cell_sizes(extent, DEEPEST))
    return [cell for cell in sizes if deepest(cell) <= most] or sizes[-1:]


def farthest_depth(dense_dir: Path, view: View) -> float:
    """Return the largest depth that the map of a photo knows; beyond, it is no evidence."""
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
