"""Compare a reconstruction with the ground truth of a rendered photo folder."""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from sfm_app.geometry.poses import Similarity, robust_similarity
from sfm_app.geometry.triangles import areas
from sfm_app.meshing.ray_casting import load_open3d
from sfm_app.synthetic.cameras import Camera, pixel_rays
from sfm_app.synthetic.photo_folder import Truth
from sfm_app.synthetic.render import cast_rays, ray_caster
from sfm_app.types.arrays import FloatArray, IndexArray
from sfm_app.types.scene import camera_center

SAMPLES = 20_000
"""Points sampled on a surface."""


def focal_error_percent(K: FloatArray, truth: Truth) -> float:
    """Return e_focal of thesis section 5.5.3: mean error of fx and fy in percent of the truth, `Truth.K`."""
    return float(50.0 * sum(abs(K[i, i] / truth.K[i, i] - 1.0) for i in (0, 1)))


def center_error_percent(K: FloatArray, truth: Truth) -> float:
    """Return e_OC of thesis section 5.5.3: mean error of the optical center's x and y in percent of the truth."""
    return float(50.0 * sum(abs(K[i, 2] / truth.K[i, 2] - 1.0) for i in (0, 1)))


def surface_errors(
    vertices: FloatArray, faces: IndexArray, centers: Mapping[str, FloatArray], truth: Truth
) -> tuple[FloatArray, FloatArray]:
    """Return distances of a reconstructed surface to the true one, and of the true one to it, in scene sizes.

    The reconstruction is aligned with the truth by the similarity between the camera centers. The first distances are
    of points spread evenly over its area, the second those of `seen_points`. The scene's size is the diagonal of the
    bounding box of the true surface that the photos see. ValueError for fewer than 3 common photos or a surface without
    area; NumericalError if the camera centers lie on a line.
    """
    aligned, size = align_centers(centers, truth)(vertices), scene_size(truth)
    to_truth = surface_distances(sample_surface(aligned, faces, SAMPLES)[0], truth.vertices, truth.faces)
    return to_truth / size, surface_distances(seen_points(truth), aligned, faces) / size


def scene_size(truth: Truth) -> float:
    """Return the diagonal of the bounding box of the visible true surface, in scene units."""
    return float(np.linalg.norm(np.ptp(seen_points(truth), axis=0)))


@lru_cache(maxsize=1)
def seen_points(truth: Truth) -> FloatArray:
    """Return (N, 3) points where a regular grid of rays through all photos meets the true surface."""
    caster = ray_caster(truth.vertices, truth.faces)
    parts = []
    for name, pose in truth.cam_from_world.items():
        camera = truth.cameras[name]
        shrink = 96 / max(camera.width, camera.height)
        size = round(camera.width * shrink), round(camera.height * shrink)
        small = Camera(np.diag([shrink, shrink, 1.0]) @ camera.K, *size, camera.lens)
        directions = pixel_rays(small) @ pose[:, :3]
        depth = cast_rays(caster, camera_center(pose), directions)["t_hit"].astype(np.float64)
        hit = np.isfinite(depth)
        parts.append(camera_center(pose) + directions[hit] * depth[hit, None])
    return np.concatenate(parts)


def align_centers(centers: Mapping[str, FloatArray], truth: Truth) -> Similarity:
    """Return the similarity from estimated camera centers (3,), by photo, to the true ones, robust to wrong poses."""
    true_centers = truth.centers
    names = sorted(set(centers) & set(true_centers))
    if len(names) < 3:
        raise ValueError(f"{len(names)} of the estimated camera centers are in the truth; 3 are needed")
    a = np.array([centers[name] for name in names], dtype=np.float64)
    b = np.array([true_centers[name] for name in names])
    return robust_similarity(a, b)


def sample_surface(vertices: FloatArray, faces: IndexArray, count: int) -> tuple[FloatArray, IndexArray]:
    """Return points (count, 3) spread uniformly over triangles (T, 3) of vertices (V, 3), and the triangle of each."""
    area = areas(vertices, faces)
    if not area.sum() > 0:
        raise ValueError("the surface has no area")
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    corners = vertices[faces[chosen]]
    u, v = rng.uniform(size=(2, count, 1))
    # folding the unit square onto the triangle keeps the points uniform
    outside = u + v > 1.0
    u, v = np.where(outside, 1.0 - u, u), np.where(outside, 1.0 - v, v)
    return np.asarray(corners[:, 0] * (1.0 - u - v) + corners[:, 1] * u + corners[:, 2] * v), chosen


def surface_distances(points: FloatArray, vertices: FloatArray, faces: IndexArray) -> FloatArray:
    """Return (N,) distances from points (N, 3) to the triangles, in single precision."""
    queries = load_open3d().core.Tensor(points.astype(np.float32))
    return np.asarray(ray_caster(vertices, faces).compute_distance(queries).numpy(), dtype=np.float64)
