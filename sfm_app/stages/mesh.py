"""mesh: Scene, dense workspace -> Surface."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.dense import map_file, read_views
from sfm_app.colmap.surface import FUSED, open_points
from sfm_app.errors import ReconstructionError
from sfm_app.files import digest_files, is_made_from
from sfm_app.meshing.cleaning import drop_islands, make_manifold
from sfm_app.meshing.refinement import STEPS
from sfm_app.products import write_surface
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.cost_estimate import block_count
from sfm_app.runtime.parallel import ordered_map
from sfm_app.stereo import View
from sfm_app.surface.blocks import mesh_in_blocks, simplify_mesh
from sfm_app.surface.fusion import fuse_maps
from sfm_app.surface.refining import FineShape, Originals, rank_partners, refine_surface, save_fine
from sfm_app.surface.spanning import Evidence, gather, span
from sfm_app.types import Scene, Surface

FUSED_DIGEST = "fused.txt"
"""File with the hash of the fused points, by which a resumed run detects damage."""
HINT = "take more photos, a step apart, with more overlap; OUT/points.ply and OUT/points.glb have the sparse points"


def make(scene: Scene, dense_dir: Path, run: RunContext) -> Surface:
    """Span a surface over the fused points, confirm, refine and simplify it; raise a ReconstructionError if none."""
    place, options = run.workspace.surface, run.settings.mesh
    place.mkdir(exist_ok=True)
    run.workspace.fine_surface.unlink(missing_ok=True)
    views = [view for view in read_views(dense_dir) if map_file(dense_dir, view).exists()]
    points = _fused_points(dense_dir, views, run)
    originals = Originals(scene.model_dir, run.workspace.photos, run.mask_dir)
    if block_count(len(points), options) > 1:
        surface = mesh_in_blocks(dense_dir, originals, views, points, run)
    else:
        surface = _mesh_at_once((dense_dir, originals), views, points, run)
    run.record(vertices=len(surface.vertices), triangles=len(surface.faces))
    write_surface(surface, run.workspace)
    return surface


def _mesh_at_once(
    source: tuple[Path, Originals], views: list[View], points: NDArray[np.void], run: RunContext
) -> Surface:
    (dense_dir, originals), options = source, run.settings.mesh

    def spread(ask: Callable[[Any], Any], items: Sequence[Any]) -> Iterator[Any]:
        return ordered_map(run.executor, ask, items, ahead=run.workers)

    with run.step("finding the surface"):
        evidence = Evidence(dense_dir, views, run.settings.depth.consistency, spread)
        raw, _ = span(gather(points, views), evidence, close=options.watertight)
    run.record(raw_triangles=len(raw.faces))
    detailed = _check_nonempty(drop_islands(raw, options.min_island), "the photos confirm no part of the surface")
    run.record(detailed_triangles=len(detailed.faces))
    if options.max_image_size_px:
        detailed = _refine(detailed, originals, views, run)
    if run.settings.texture.normal_map:
        save_fine([FineShape.from_surface(detailed)], run.workspace.fine_surface)
    with run.step("simplifying"):
        simple = make_manifold(simplify_mesh(detailed, options, run.workspace.surface, run.workers))
    return _check_nonempty(simple, "the surface has no extent")


def _refine(surface: Surface, originals: Originals, views: list[View], run: RunContext) -> Surface:
    def spread(ask: Callable[[int], Any], photos: Sequence[int]) -> Iterator[Any]:
        for answer in ordered_map(run.executor, ask, photos, ahead=2 * run.workers):
            run.progress.advance()
            yield answer

    run.progress.start("refining the surface", (1 + STEPS) * len(views))  # reading counts as a step
    try:
        refined = refine_surface(surface, originals, views, rank_partners(views), run.settings.mesh, spread)
    finally:
        run.progress.finish()
    if refined.failed:
        run.record(refinement_failed=refined.failed)
        run.progress.say(f"the surface is not refined by the photos: {refined.failed}")
    run.record(refined_triangles=len(refined.surface.faces))
    run.record(photo_correlations=[round(one, 4) for one in refined.correlations])
    return refined.surface


def _check_nonempty(surface: Surface, problem: str) -> Surface:
    if not len(surface.faces):
        raise ReconstructionError(problem, hint=HINT)
    return surface


def _fused_points(dense_dir: Path, views: list[View], run: RunContext) -> NDArray[np.void]:
    """Return the records (N,) of the fused points; fuse again if they are damaged or a map is newer."""
    if not views:
        raise ReconstructionError("no photo has a depth map", hint=HINT)
    place = run.workspace.surface
    target = place / FUSED
    files = [map_file(dense_dir, view) for view in views]
    newest = max(path.stat().st_mtime_ns for path in (*files, files[0].parent))
    marker = place / FUSED_DIGEST
    sound = target.exists() and is_made_from(marker, digest_files(place, FUSED))
    if not sound or target.stat().st_mtime_ns <= newest:
        fuse_maps(dense_dir, views, _min_views(views, run), target, run)
        marker.write_text(digest_files(place, FUSED), encoding="utf-8", newline="\n")
    points = open_points(target)
    run.record(fused_points=len(points))
    if len(points) < 100:
        raise ReconstructionError(
            f"the {len(views)} depth maps agree on only {len(points)} points: too few for a surface", hint=HINT
        )
    return points


def _min_views(views: list[View], run: RunContext) -> int:
    """Return the number of photos that have to see a fused point."""
    return min(1 + run.settings.depth.min_agreeing, len(views))
