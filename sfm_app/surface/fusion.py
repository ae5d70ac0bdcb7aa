"""Fusion of depth maps in blocks: COLMAP holds the maps of one block only.

A block is a box. Its workspace has the photos with depths in it, and of these the depths in it and a little beyond, so
that all blocks together are little more work than the whole.
"""

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.dense import map_file, normals_file, read_depth, read_gray, write_depth, write_fusion_views
from sfm_app.colmap.surface import FUSED, fuse, open_points, positions, write_points
from sfm_app.files import fingerprint, mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.meshing.blocks import split_points
from sfm_app.meshing.refinement import finest_pixels
from sfm_app.meshing.tetrahedra import OPTIONS
from sfm_app.numerical import local_deviation
from sfm_app.operating_system import share_bytes
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.cost_estimate import FUSED_AT_ONCE_MP, MAPS_MB_PER_MP, cache_gb
from sfm_app.stereo import View, region
from sfm_app.stereo.patch_match import BORDER
from sfm_app.surface.spanning import GAP
from sfm_app.tasks import Task
from sfm_app.types.arrays import BoolArray, FloatArray

MOST_PIXELS = int(1e6 * FUSED_AT_ONCE_MP)
"""Pixels of depth maps that are fused at once."""
STRIDE = 16
"""Pixels from one sample of a map to the next. Chosen by hand."""
BEYOND = 0.03
"""Largest distance of a pixel from a block, as a share of its depth: three times COLMAP's tolerance of the depths of a
point."""
LONE = 3.0
"""Least distance of a point of too few photos from all others, in distances of points: a nearer one is their noise.
Chosen by hand. The greatest is GAP: farther points have nothing to confirm them, and open the ground of castle-P19."""
WINDOW_PX = 2 * BORDER + 1
"""Side of the square of pixels that matching compares."""
LEAST_TEXTURE = 1.5
"""Least standard deviation of the gray levels in it where one photo alone shows a point. Chosen by hand: skies have 0.7
to 1.4."""
OWN_DEPTH = 1e-3
"""Relative difference within which a point of one photo is that of a pixel: rounding."""
FUSING = "fusing"
"""Folder beside the points while they are fused."""


@dataclass(frozen=True, slots=True, eq=False)
class FusionTask:
    """Input of one block besides the files, for any process."""

    dense_dir: Path
    folder: Path
    number: int
    views: Sequence[View]
    """Photos with depths in the block."""
    box: FloatArray
    """(2, 3) lowest and highest coordinates of its points."""
    min_views: int
    """Photos that have to see a point."""
    memory_gb: float

    @property
    def path(self) -> Path:
        """The points of the block."""
        return self.folder / f"{self.number}.ply"


def fuse_maps(dense_dir: Path, views: Sequence[View], min_views: int, target: Path, run: RunContext) -> None:
    """Fuse all maps of a dense workspace into a PLY file of points, at once or block by block."""
    pixels = sum(view.width * view.height for view in views)
    if pixels <= MOST_PIXELS:
        with run.step("fusing depth maps"), replace_atomically(target) as path:
            fuse_points(dense_dir, views, min_views, region(views), path, cache_gb(run.memory_mb))
        return
    folder = target.parent / FUSING
    stamps = [[view.name, map_file(dense_dir, view).stat().st_mtime_ns] for view in views]
    made_from = fingerprint(run.fingerprint, stamps, min_views)
    if not resume_or_clear(folder, made_from):
        mark_unfinished(folder, made_from)
    tasks = plan_fusion(dense_dir, views, min_views, folder, run)
    run.record(fusion_blocks=len(tasks))
    run.map(Task(fuse_block), tasks, "fusing depth maps in blocks")
    with replace_atomically(target) as path:
        write_points([open_points(task.path) for task in tasks if task.path.stat().st_size], path)
    shutil.rmtree(folder)


def plan_fusion(
    dense_dir: Path, views: Sequence[View], min_views: int, folder: Path, run: RunContext
) -> list[FusionTask]:
    """Divide the space that the depth maps show into blocks."""
    pixels, whole = sum(view.width * view.height for view in views), region(views)
    bare = [view.bare for view in views]
    samples = run.map(Task(sample_points, dense_dir), bare, "measuring depths")
    inside = [part[((part >= whole[0]) & (part <= whole[1])).all(axis=1)] for part in samples]
    partition = split_points(np.concatenate(inside), -(-pixels // MOST_PIXELS))
    blocks_of = [set(partition.find_blocks(part).tolist()) for part in inside]
    memory_gb = cache_gb(run.memory_mb) / run.workers
    return [
        FusionTask(
            dense_dir,
            folder,
            number,
            [view for view, blocks in zip(bare, blocks_of, strict=True) if number in blocks],
            np.stack([np.maximum(box[0], whole[0]), np.minimum(box[1], whole[1])]),
            min_views,
            memory_gb,
        )
        for number, box in enumerate(partition.boxes)
    ]


def fuse_block(task: FusionTask) -> None:
    """Write the points of a block, unless a killed run has; an empty file where there are none."""
    if task.path.exists():
        return
    # a worker that was cut off from a cluster may still be at the same block
    scratch = Path(tempfile.mkdtemp(dir=task.folder, prefix=f"{task.number}-"))
    for folder in ("sparse", "images", "stereo"):
        (scratch / folder).mkdir()
    for path in sorted((task.dense_dir / "sparse").iterdir()):
        if path.is_file():
            share_bytes(path, scratch / "sparse" / path.name)
    for view in task.views:
        for file in (Path("images") / view.name, normals_file(Path(), view)):
            (scratch / file).parent.mkdir(parents=True, exist_ok=True)
            share_bytes(task.dense_dir / file, scratch / file)
        depth = read_depth(task.dense_dir, view, "geometric")
        write_depth(scratch, view, np.where(is_near(view, depth, task.box), depth, np.float32(0)))
    write_fusion_views(scratch, task.views)
    with replace_atomically(task.path) as path:
        if task.views:
            fuse_points(scratch, task.views, task.min_views, task.box, path, task.memory_gb)
        else:
            path.touch()
    shutil.rmtree(scratch)


def fuse_points(
    dense_dir: Path, views: Sequence[View], min_views: int, box: FloatArray, target: Path, memory_gb: float
) -> None:
    """Fuse maps into the points of a box (2, 3) that enough photos see, and others beside them where there are none.

    What a thing half hides may be in one photo only; elsewhere such a point is noise.
    """
    from scipy.spatial import cKDTree

    needed_mb = MAPS_MB_PER_MP * sum(view.width * view.height for view in views) / 1e6
    with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
        everything = Path(scratch) / FUSED
        seen = fuse(dense_dir, everything, memory_gb if needed_mb > 1000 * memory_gb else 0.0)
        records = np.array(open_points(everything))  # in memory: an open file cannot be removed everywhere
    places = positions(records)
    keep = seen >= min_views
    lone = np.flatnonzero(~keep)
    gap, _ = cKDTree(places[keep]).query(places[lone])
    step = OPTIONS.spacing_px * finest_pixels(places[lone], views)
    beside = lone[(gap > LONE * step) & (gap < GAP * step)]
    keep[beside] = show_texture(places[beside], dense_dir, views)
    keep &= ((places >= box[0]) & (places <= box[1])).all(axis=1)
    write_points([records[keep]], target)


def show_texture(points: FloatArray, dense_dir: Path, views: Sequence[View]) -> BoolArray:
    """Return (N,) whether a photo shows texture where its map has a point: the spill into a plain sky has none."""
    found = np.zeros(len(points), np.bool_)
    for view in views:
        depth = read_depth(dense_dir, view, "geometric")
        textured = local_deviation(read_gray(dense_dir, view), WINDOW_PX) >= LEAST_TEXTURE
        u, v, z = view.projection @ np.column_stack([points, np.ones(len(points))]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            col, row = np.rint(np.stack([u, v]) / z - view.sample_px)
        at = np.flatnonzero((z > 0) & (col >= 0) & (row >= 0) & (col < view.width) & (row < view.height))
        row, col = row[at].astype(np.int64), col[at].astype(np.int64)
        found[at] |= textured[row, col] & np.isclose(depth[row, col], z[at], rtol=OWN_DEPTH)
    return found


def sample_points(dense_dir: Path, view: View) -> FloatArray:
    """Return points (N, 3) of every `STRIDE`-th row and column of a map."""
    depth = read_depth(dense_dir, view, "geometric")[::STRIDE, ::STRIDE]
    rows, columns = depth.shape
    x, y = np.meshgrid(STRIDE * np.arange(columns) + view.sample_px, STRIDE * np.arange(rows) + view.sample_px)
    points: FloatArray = (view.rays(np.stack([x, y], axis=2)) * depth[..., None] - view.t) @ view.R
    return points[depth > 0]


def is_near(view: View, depth: NDArray[np.float32], box: FloatArray) -> NDArray[np.bool_]:
    """Return (H, W) whether depths (H, W) lie in a box (2, 3) or little beyond it."""
    rays = view.R.T @ np.linalg.inv(view.K)
    rows, columns = depth.shape
    x, y = np.arange(columns) + view.sample_px, np.arange(rows)[:, None] + view.sample_px
    near, beyond = np.ones(depth.shape, np.bool_), np.float32(BEYOND) * depth
    for axis, center in enumerate(view.center):
        ray = (rays[axis, 0] * x + rays[axis, 2] + rays[axis, 1] * y).astype(np.float32)
        place = ray * depth + np.float32(center)
        near &= (place >= np.float32(box[0, axis]) - beyond) & (place <= np.float32(box[1, axis]) + beyond)
    return near
