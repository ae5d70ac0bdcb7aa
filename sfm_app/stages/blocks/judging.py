"""What the surface at once and the surface in blocks have in common: the photos' judgment, and simplification."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.dense import read_color, read_depth
from sfm_app.colmap.surface import simplify
from sfm_app.geometry.culling import Clusters, cluster
from sfm_app.geometry.triangles import median_edge_length, vertex_normals
from sfm_app.meshing import CONFIRMED, NO_EVIDENCE, DepthView, Paint, Support, judge, sample_colors
from sfm_app.settings import MeshSettings
from sfm_app.stereo import View
from sfm_app.tasks import Shared
from sfm_app.types import Surface

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
            surface: triangles.
            dense_dir: folder with undistorted photos and their maps.
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
        """Return the surface with colors from the photos, and their support for each of its vertices.

        Args:
            judgments: of all photos, in their order.
        """
        support, paint = Support.zeros(len(self.normals)), Paint.zeros(len(self.normals))
        for at, verdict, colors in judgments:
            support.add(at, verdict)
            paint.add(at, colors)
        surface = self.surface
        return Surface(surface.vertices, surface.faces, paint.mean_colors(surface.vertices)), support


def judge_by_all(judge: SurfaceJudge, views: Sequence[View]) -> tuple[Surface, Support, list[View]]:
    """Return what `sum_up` does, and the photos that confirm enough of the surface to refine it.

    Args:
        judge: prepared for the surface.
        views: the photos.
    """
    seers = list[View]()

    def ask(view: View) -> Judgment:
        said = judge.judge(view)
        if np.count_nonzero(said[1] == CONFIRMED) >= LEAST_CONFIRMED:
            seers.append(view)
        return said

    return *judge.sum_up(map(ask, views)), seers


def judge_view(judges: Shared[SurfaceJudge], view: View) -> Judgment:
    """Let one photo judge the vertices that it has in view, on any machine.

    Args:
        judges: prepared for the surface.
        view: the photo.
    """
    return judges.value.judge(view)


def simplify_mesh(surface: Surface, options: MeshSettings, scratch: Path, threads: int = 1) -> Surface:
    """Simplify to as few triangles as the error allows, and no more than asked for.

    Args:
        surface: detailed triangles.
        options: largest error, and most triangles.
        scratch: folder for temporary files.
        threads: number of threads; the surface is the same for any.
    """
    if not options.max_error_edges and len(surface.faces) <= options.faces:
        return surface
    edge = median_edge_length(surface.vertices, surface.faces)
    return simplify(surface, options.faces, options.max_error_edges * edge, scratch, threads)
