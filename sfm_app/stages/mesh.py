"""mesh: dense workspace -> Surface."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.atomic_io import is_made_from, replace_atomically
from sfm_app.colmap.dense import map_file, read_color, read_depth, read_views
from sfm_app.colmap.surface import FUSED, fuse, poisson_surface, read_fused, simplify
from sfm_app.errors import ReconstructionError
from sfm_app.geometry.triangles import median_edge_length, vertex_normals
from sfm_app.hashing import digest_files, load_arrays
from sfm_app.meshing import (
    DepthView,
    Paint,
    Support,
    drop_islands,
    judge,
    make_manifold,
    octree_depth,
    sample_colors,
    trim,
)
from sfm_app.progress import track
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.cost_estimate import cache_gb
from sfm_app.runtime.parallel import ordered_map
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import MeshSettings
from sfm_app.stereo import View, region
from sfm_app.tasks import Shared, Task
from sfm_app.types import Surface

SURFACE = "surface.npz"
FUSED_DIGEST = "fused.txt"
"""File with the hash of the fused points, so that a resumed run does not read damaged ones."""
HINT = "take more photos, a step apart, with more overlap; OUT/points.ply and OUT/points.glb have the sparse points"

MIN_POINTS = 100
"""Fewer fused points carry no surface."""

CONFIRMED_SHARE = 2 / 3
"""A part stays when this share of the photos that a fused point needs confirms its average vertex."""


def make(dense_dir: Path, run: RunContext) -> Surface:
    """Span a surface over the fused points, keep what the photos confirm, and simplify it.

    Args:
        dense_dir: dense workspace with depth maps.
        run: the run.

    Raises:
        ReconstructionError: the depth maps do not give a surface; the message says why.
        BackendError: COLMAP failed.
    """
    place, options = run.workspace.surface, run.settings.mesh
    place.mkdir(exist_ok=True)
    views = [view for view in read_views(dense_dir) if map_file(dense_dir, view).exists()]
    points = _fused_points(dense_dir, views, run)
    depth = octree_depth(points, options.poisson_depth)
    with run.step("finding the surface"):
        raw = _check_nonempty(poisson_surface(place, depth), "the fused points span no surface")
    colored, support = color_and_confirm(raw, dense_dir, views, run)
    least = CONFIRMED_SHARE * _min_views(views, run)
    trimmed = trim(colored, support, options.max_gap_triangles, least) if options.trim else colored
    detailed = _check_nonempty(drop_islands(trimmed, options.min_island), "the photos confirm no part of the surface")
    run.record(poisson_depth=depth, raw_triangles=len(raw.faces), detailed_triangles=len(detailed.faces))
    with run.step("simplifying"):
        surface = _check_nonempty(make_manifold(simplify_mesh(detailed, options, place)), "the surface has no extent")
    run.record(vertices=len(surface.vertices), triangles=len(surface.faces))
    with replace_atomically(place / SURFACE) as path:
        np.savez(path, vertices=surface.vertices, faces=surface.faces, colors=surface.colors)
    return surface


def _check_nonempty(surface: Surface, otherwise: str) -> Surface:
    """Return the surface after checking that it has triangles.

    Raises:
        ReconstructionError: it has none.
    """
    if not len(surface.faces):
        raise ReconstructionError(otherwise, hint=HINT)
    return surface


def load(run: RunContext) -> Surface:
    """Read the surface back."""
    stored = load_arrays(run.workspace.surface / SURFACE)
    return Surface(stored["vertices"], stored["faces"], stored["colors"])


def digest(place: Workspace) -> str:
    """Return a hash of the surface."""
    return digest_files(place.surface, SURFACE)


def _fused_points(dense_dir: Path, views: list[View], run: RunContext) -> NDArray[np.float64]:
    """Return the (N, 3) points fused from all depth maps; fuse again only where a map or their folder is newer."""
    if not views:
        raise ReconstructionError("no photo has a depth map", hint=HINT)
    place = run.workspace.surface
    target = place / FUSED
    files = [map_file(dense_dir, view) for view in views]
    youngest = max(path.stat().st_mtime_ns for path in (*files, files[0].parent))
    whole = place / FUSED_DIGEST
    sound = target.exists() and is_made_from(whole, digest_files(place, FUSED))
    if not sound or target.stat().st_mtime_ns <= youngest:
        with run.step("fusing depth maps"), replace_atomically(target) as path:
            fuse(dense_dir, _min_views(views, run), region(views), path, cache_gb(run.memory_mb))
        whole.write_text(digest_files(place, FUSED), encoding="utf-8")
    points, _ = read_fused(place)
    run.record(fused_points=len(points))
    if len(points) < MIN_POINTS:
        raise ReconstructionError(
            f"the {len(views)} depth maps agree on {len(points) or 'no'} points only: too few for a surface", hint=HINT
        )
    return points


def _min_views(views: list[View], run: RunContext) -> int:
    """Return how many photos have to see a fused point."""
    return min(1 + run.settings.depth.min_agreeing, len(views))


def color_and_confirm(surface: Surface, dense_dir: Path, views: list[View], run: RunContext) -> tuple[Surface, Support]:
    """Return the surface with colors from the photos, and their support for each of its vertices.

    Args:
        surface: from Poisson reconstruction.
        dense_dir: folder with undistorted photos and their maps.
        views: photos with a depth map.
        run: the run.
    """
    normals = vertex_normals(surface.vertices, surface.faces)
    judge_view = Task(_judge_view, Shared((surface.vertices, normals)), dense_dir, run.settings.depth.consistency)
    support, paint = Support.zeros(len(normals)), Paint.zeros(len(normals))
    found = ordered_map(run.executor, judge_view, views, ahead=run.workers)
    for verdict, colors in track(run.progress, found, "confirming the surface", len(views)):
        support.add(verdict)
        paint.add(colors)
    return Surface(surface.vertices, surface.faces, paint.mean_colors(surface.colors)), support


def _judge_view(
    raw: Shared[tuple[NDArray[np.float64], NDArray[np.float64]]], dense_dir: Path, tolerance: float, view: View
) -> tuple[NDArray[np.uint8], Paint]:
    """Return what a photo says of each vertex, and the colors that it gives them."""
    vertices, normals = raw.value
    eye = DepthView(view.K, view.R, view.t, read_depth(dense_dir, view, "geometric"), view.sample_px)
    verdict = judge(vertices, normals, eye, tolerance)
    return verdict, sample_colors(vertices, normals, verdict, eye, read_color(dense_dir, view))


def simplify_mesh(surface: Surface, options: MeshSettings, scratch: Path) -> Surface:
    """Simplify to as few triangles as the error allows, and no more than asked for.

    Args:
        surface: detailed triangles.
        options: largest error, and most triangles.
        scratch: folder for temporary files.
    """
    simple = surface
    if options.max_error_edges:
        edge = median_edge_length(surface.vertices, surface.faces)
        simple = simplify(surface, 1.0 / len(surface.faces), options.max_error_edges * edge, scratch)
    if len(simple.faces) > options.faces:
        simple = simplify(simple, options.faces / len(simple.faces), 0.0, scratch)
    return simple
