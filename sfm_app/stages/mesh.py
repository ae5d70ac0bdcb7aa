"""mesh: Scene, dense workspace -> Surface."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.dense import map_file, read_views
from sfm_app.colmap.surface import FUSED, open_points, positions
from sfm_app.errors import ReconstructionError
from sfm_app.files import digest_files, is_made_from, load_arrays, replace_atomically
from sfm_app.meshing import drop_islands, make_manifold, trim
from sfm_app.meshing.octree import LEAST_POINTS, cell_sizes, choose_cell, cube_around
from sfm_app.meshing.refinement import STEPS
from sfm_app.progress import track
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.cost_estimate import block_count
from sfm_app.runtime.parallel import ordered_map
from sfm_app.runtime.workspace import Workspace
from sfm_app.stereo import View
from sfm_app.surface.blocks import (
    EVERYWHERE,
    RecordCells,
    SurfaceJudge,
    judge_view,
    mesh_in_blocks,
    simplify_mesh,
    span_surface,
    with_halo,
)
from sfm_app.surface.fusion import fuse_maps
from sfm_app.surface.refining import FineShape, Originals, rank_partners, refine_surface, save_fine
from sfm_app.tasks import Shared, Task
from sfm_app.types import Scene, Surface

SURFACE = "surface.npz"
FUSED_DIGEST = "fused.txt"
"""File with the hash of the fused points, so that a resumed run does not read damaged ones."""
HINT = "take more photos, a step apart, with more overlap; OUT/points.ply and OUT/points.glb have the sparse points"

FEWEST_POINTS = 100
"""Fewer fused points carry no surface."""

MOST_CELLS_PER_FACE = 1.6
"""Occupied cells of Poisson's octree for each triangle of the finished mesh, where it is not refined: four triangles
are simplified to one. Chosen at `draft` on fountain-P11."""
CONFIRMED_SHARE = 2 / 3
"""A part stays when this share of the photos that a fused point needs confirms its average vertex."""


def make(scene: Scene, dense_dir: Path, run: RunContext) -> Surface:
    """Span a surface over the fused points, keep what the photos confirm, refine it by them, and simplify it.

    Raises:
        ReconstructionError: the depth maps do not give a surface; the message says why.
        BackendError: COLMAP failed.
    """
    place, options = run.workspace.surface, run.settings.mesh
    place.mkdir(exist_ok=True)
    run.workspace.fine_surface.unlink(missing_ok=True)
    views = [view for view in read_views(dense_dir) if map_file(dense_dir, view).exists()]
    points = _fused_points(dense_dir, views, run)
    originals = Originals(scene.model_dir, run.workspace.photos, run.mask_dir)
    if block_count(len(points), options) > 1:
        surface = mesh_in_blocks((dense_dir, originals), views, points, _min_confirmed(views, run), run)
    else:
        surface = _mesh_at_once((dense_dir, originals), views, points, run)
    run.record(vertices=len(surface.vertices), triangles=len(surface.faces))
    with replace_atomically(place / SURFACE) as path:
        np.savez(path, vertices=surface.vertices, faces=surface.faces, colors=surface.colors)
    return surface


def _mesh_at_once(
    source: tuple[Path, Originals], views: list[View], points: NDArray[np.void], run: RunContext
) -> Surface:
    """Return the surface of all points.

    Args:
        points: (N,) records of the fused points.
    """
    (dense_dir, originals), options = source, run.settings.mesh
    raw = _check_nonempty(_span(points, run), "the fused points span no surface")
    judges = SurfaceJudge.prepare(raw, dense_dir, run.settings.depth.consistency)
    found = ordered_map(run.executor, Task(judge_view, Shared(judges)), views, ahead=run.workers)
    colored, support = judges.sum_up(track(run.progress, found, "confirming the surface", len(views)))
    least = _min_confirmed(views, run)
    trimmed = trim(colored, support, options.max_gap_triangles, least) if options.trim else colored
    detailed = _check_nonempty(drop_islands(trimmed, options.min_island), "the photos confirm no part of the surface")
    run.record(detailed_triangles=len(detailed.faces))
    if options.max_image_size_px:
        detailed = _refine(detailed, originals, views, run)
    if run.settings.texture.normal_map:
        save_fine([FineShape.from_surface(detailed)], run.workspace.fine_surface)
    with run.step("simplifying"):
        simple = make_manifold(simplify_mesh(detailed, options, run.workspace.surface, run.workers))
    return _check_nonempty(simple, "the surface has no extent")


def _span(points: NDArray[np.void], run: RunContext) -> Surface:
    """Return Poisson's surface of all points, as fine as there are points, and as triangles are asked for."""
    options, where = run.settings.mesh, positions(points)
    bounds = np.stack([where.min(axis=0), where.max(axis=0)])
    if (extent := float(np.ptp(bounds, axis=0).max())) == 0.0:
        raise ReconstructionError("the fused points have no extent", hint=HINT)
    # a surface that is not refined loses most of its triangles at once
    most_cells = np.inf if options.max_image_size_px else MOST_CELLS_PER_FACE * options.faces
    sizes = list(cell_sizes(extent, options.poisson_depth))
    with run.step("finding the surface"):
        cell = choose_cell(sizes, RecordCells(lambda: [points]), max(LEAST_POINTS, len(where) / most_cells))
        cube = cube_around(bounds[0], bounds[1], cell)
        kept = with_halo(bounds, cell) if options.trim else EVERYWHERE
        surface, raw = span_surface(points, kept, cube, run.workspace.surface)
    run.record(cell=cell, raw_triangles=raw)
    return surface


def _refine(surface: Surface, originals: Originals, views: list[View], run: RunContext) -> Surface:
    """Return the surface with the detail of the photos."""

    def spread(ask: Callable[[int], Any], photos: Sequence[int]) -> Iterator[Any]:
        for found in ordered_map(run.executor, ask, photos, ahead=2 * run.workers):
            run.progress.advance()
            yield found

    run.progress.start("refining the surface", (1 + STEPS) * len(views))  # each is read, too
    try:
        found = refine_surface(surface, originals, views, rank_partners(views), run.settings.mesh, spread)
    finally:
        run.progress.finish()
    if found.failed:
        run.record(refinement_failed=found.failed)
        run.progress.say(f"the surface stays as the depth maps have it: {found.failed}")
    run.record(refined_triangles=len(found.surface.faces))
    run.record(photo_correlations=[round(one, 4) for one in found.correlations])
    return found.surface


def _check_nonempty(surface: Surface, otherwise: str) -> Surface:
    """Return the surface after checking that it has triangles; raise a ReconstructionError if it has none."""
    if not len(surface.faces):
        raise ReconstructionError(otherwise, hint=HINT)
    return surface


def load(run: RunContext) -> Surface:
    """Read the surface back."""
    stored = load_arrays(run.workspace.surface / SURFACE)
    return Surface(stored["vertices"], stored["faces"], stored["colors"])


def digest(place: Workspace) -> str:
    """Return a hash of the surface, and of the fine one where it is kept."""
    fine = place.fine_surface
    return digest_files(place.surface, SURFACE, *([fine.name] if fine.exists() else []))


def _fused_points(dense_dir: Path, views: list[View], run: RunContext) -> NDArray[np.void]:
    """Return the records (N,) of the fused points; fuse again only where a map or their folder is newer."""
    if not views:
        raise ReconstructionError("no photo has a depth map", hint=HINT)
    place = run.workspace.surface
    target = place / FUSED
    files = [map_file(dense_dir, view) for view in views]
    youngest = max(path.stat().st_mtime_ns for path in (*files, files[0].parent))
    whole = place / FUSED_DIGEST
    sound = target.exists() and is_made_from(whole, digest_files(place, FUSED))
    if not sound or target.stat().st_mtime_ns <= youngest:
        fuse_maps(dense_dir, views, _min_views(views, run), target, run)
        whole.write_text(digest_files(place, FUSED), encoding="utf-8", newline="\n")
    points = open_points(target)
    run.record(fused_points=len(points))
    if len(points) < FEWEST_POINTS:
        raise ReconstructionError(
            f"the {len(views)} depth maps agree on {len(points) or 'no'} points only: too few for a surface", hint=HINT
        )
    return points


def _min_views(views: list[View], run: RunContext) -> int:
    """Return how many photos have to see a fused point."""
    return min(1 + run.settings.depth.min_agreeing, len(views))


def _min_confirmed(views: list[View], run: RunContext) -> float:
    """Return how many photos have to confirm the average vertex of a part."""
    return CONFIRMED_SHARE * _min_views(views, run)
