"""What smooth bodies say nothing about: fine detail, sharp edges, thin things, ground at a low angle, and flakes."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.results import Row
from benchmarks.surface.rendered.truth import Sights, sample_with_normals, sights_of
from sfm_app.synthetic.compare import align_centers, sample_surface, scene_size, surface_distances
from sfm_app.synthetic.photo_folder import Truth
from sfm_app.synthetic.shapes import SyntheticScene
from sfm_app.types import Surface

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

SAMPLES = 200_000
"""Number of points at which a surface is sampled, evenly over its area."""
LIMITS = (0.0005, 0.001, 0.002, 0.004)
"""Distances, in sizes of the scene, within which accuracy, completeness and F are counted."""
FLAKE = 0.01
"""Distance from the truth, in sizes of the scene, beyond which a piece of the mesh should not be there."""
CREASE_DEG = 40.0
"""Angle between triangles of the truth at which their edge is a crease."""
CREASE_STEP = 0.002
"""Distance of the samples along creases and thin things, in sizes of the scene."""
THIN = 0.003
"""Distance from a thin thing, in sizes of the scene, within which its mesh has to lie."""
LOW_DEG = (10.0, 20.0)
"""Range of the angle between ground and rays in which ground counts as seen at a low angle."""
GROUND_SHARE, GROUND_LIMIT, LEAST_PLACES = 0.06, 0.004, 100
"""Share of the height of the scene below which everything is ground, distance within which mesh has to lie there, in
sizes of the scene, and least number of places."""


def detail_scores(surface: Surface, centers: Mapping[str, FloatArray], truth: Truth, scene: SyntheticScene) -> Row:
    """Return the figures of fine detail, in percent; missing kinds of detail have none.

    Args:
        surface: in the frame of the reconstruction; moved onto the truth by the camera centers.
        centers: (3,) by photo name in that frame.
        truth: truth of the rendered photos.
        scene: what they show; names its thin things.
    """
    if not len(surface.faces):
        return {}
    size, aligned = scene_size(truth), align_centers(centers, truth)(surface.vertices)
    points, _ = sample_surface(aligned, surface.faces, SAMPLES)
    to_truth = surface_distances(points, truth.vertices, truth.faces) / size
    seen = sights_of(truth, *sample_with_normals(truth, 3 * SAMPLES))
    to_found = surface_distances(seen.places[seen.count >= 2], aligned, surface.faces) / size
    row: Row = {}
    for limit in LIMITS:
        accurate, complete = float(np.mean(to_truth <= limit)), float(np.mean(to_found <= limit))
        name = f"{100 * limit:g} %"
        row |= {f"accuracy {name}": _percent(accurate), f"completeness {name}": _percent(complete)}
        row[f"F {name}"] = _percent(2.0 * accurate * complete / max(accurate + complete, 1e-9))
    row["flakes %"] = _percent(float(np.mean(to_truth > FLAKE)))
    row |= _edges(truth, aligned, surface, size) | _thin(truth, scene, aligned, surface, size)
    return row | _ground(truth, seen, to_found)


def creases(vertices: FloatArray, faces: IndexArray) -> tuple[FloatArray, FloatArray]:
    """Return the ends (N, 2, 3) of edges at which triangles meet at an angle, and the mean normals there (N, 3).

    Args:
        vertices: (V, 3); those at the same place count as one.
        faces: (T, 3) vertex indices.
    """
    _, first, one = np.unique(vertices.round(6), axis=0, return_index=True, return_inverse=True)
    joined = one.ravel()[faces]
    corners = vertices[first][joined]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-12)
    edges = np.sort(np.concatenate([joined[:, [0, 1]], joined[:, [1, 2]], joined[:, [2, 0]]]), axis=1)
    face = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, face = edges[order], face[order]
    same = (edges[1:] == edges[:-1]).all(axis=1)
    a, b = face[:-1][same], face[1:][same]
    sharp = (normals[a] * normals[b]).sum(axis=1) < np.cos(np.radians(CREASE_DEG))
    mean = normals[a] + normals[b]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return vertices[first][edges[:-1][same][sharp]], mean[sharp]


def _edges(truth: Truth, aligned: FloatArray, surface: Surface, size: float) -> Row:
    """Return the median distance of creases that three photos see, and the share within the two finest limits."""
    ends, normals = creases(truth.vertices, truth.faces)
    if not len(ends):
        return {}
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    count = np.maximum(np.round(length / (CREASE_STEP * size)).astype(int), 1)
    number = np.repeat(np.arange(len(ends)), count)
    share = (np.arange(len(number)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[number]
    places = ends[number, 0] + share[:, None] * (ends[number, 1] - ends[number, 0])
    seen = sights_of(truth, places, normals[number])
    away = surface_distances(seen.places[seen.count >= 3], aligned, surface.faces) / size
    if not len(away):
        return {}
    return {
        "edges: median %": round(100.0 * float(np.median(away)), 4),
        "edges: mean %": round(100.0 * float(np.mean(np.minimum(away, FLAKE))), 4),
        "edges within 0.1 %": _percent(float(np.mean(away <= 0.001))),
    }


def _thin(truth: Truth, scene: SyntheticScene, aligned: FloatArray, surface: Surface, size: float) -> Row:
    """Return the share of the length of thin things, as far as three photos see them, that has mesh close by."""
    if not scene.thin:
        return {}
    lines = [_densely(line, CREASE_STEP * size) for line in scene.thin]
    points = np.concatenate(lines)
    seen = sights_of(truth, points[:, :3], None, slack=2.0 * points[:, 3])
    often = seen.count >= 3
    away = surface_distances(points[often, :3], aligned, surface.faces)
    return {"thin things %": _percent(float(np.mean(away <= points[often, 3] + THIN * size)))}


def _densely(line: FloatArray, step: float) -> FloatArray:
    """Return the points of a line (N, 4), and more between them, so that steps are about equal."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :3], axis=0), axis=1))])
    at = np.linspace(0.0, length[-1], 2 + round(length[-1] / step))
    return np.column_stack([np.interp(at, length, column) for column in line.T])


def _ground(truth: Truth, seen: Sights, to_found: FloatArray) -> Row:
    """Return the share of ground that two photos see, all of them at a low angle, that has mesh close by."""
    often = seen.count >= 2
    height, steepest = seen.places[often, 1], seen.steepest_deg[often]
    bottom, top = truth.vertices[:, 1].min(), truth.vertices[:, 1].max()
    low = (height < bottom + GROUND_SHARE * (top - bottom)) & (steepest > LOW_DEG[0]) & (steepest < LOW_DEG[1])
    if np.count_nonzero(low) < LEAST_PLACES:
        return {}
    return {"ground at a low angle %": _percent(float(np.mean(to_found[low] <= GROUND_LIMIT)))}


def _percent(share: float) -> float:
    return round(100.0 * share, 2)
