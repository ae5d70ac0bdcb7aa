"""Render photos of a synthetic scene by ray casting."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.meshing.open3d import load_open3d
from sfm_app.synthetic.cameras import Camera, camera_center, pixel_rays
from sfm_app.synthetic.scenes.bodies import SyntheticScene
from sfm_app.synthetic.scenes.textures import mixture

FloatArray = NDArray[np.float64]
NO_HIT = 0xFFFFFFFF
GAMMA = 2.2
# linear RGB
SUNLIGHT = np.array([1.0, 0.93, 0.82])
SKYLIGHT = np.array([0.82, 0.92, 1.0])
ZENITH = np.array([0.20, 0.38, 0.72])
HORIZON = np.array([0.66, 0.76, 0.86])
AMBIENT_RAYS = 24


@dataclass(frozen=True, slots=True, eq=False)
class PreparedScene:
    """A scene prepared for rendering many photos: ray-casting structure and shading tables."""

    rays: Any
    """Open3D RaycastingScene."""
    faces: NDArray[np.int64]
    vertex_table: FloatArray
    """(V, 7): normal, texture coordinates, and the visible share of the sky (ambient occlusion)."""
    face_material: NDArray[np.int64]
    materials: FloatArray
    lights: FloatArray
    """(5, 3): direction to the sun, sun and sky colors, zenith and horizon colors."""


def prepare(scene: SyntheticScene) -> PreparedScene:
    """Build the ray-casting structure and tables of a scene once for all photos."""
    vertices, faces = scene.vertices, scene.faces
    shapes = [body.shape for body in scene.bodies]
    normals = np.concatenate([shape.normals for shape in shapes])
    caster = ray_caster(vertices, faces)
    openness = scene.bounced + (1.0 - scene.bounced) * _openness(caster, vertices, normals)
    sun = np.array(scene.to_light) / np.linalg.norm(scene.to_light)
    texture = np.concatenate([shape.texture for shape in shapes])
    return PreparedScene(
        rays=caster,
        faces=faces,
        vertex_table=np.column_stack([normals, texture, openness]),
        face_material=np.repeat(np.arange(len(shapes)), [len(shape.faces) for shape in shapes]),
        materials=np.stack([body.material.row(100 * k) for k, body in enumerate(scene.bodies)]),
        lights=np.stack([sun, SUNLIGHT * scene.sun, SKYLIGHT * scene.sky, ZENITH, HORIZON]),
    )


def render_scene(
    scene: PreparedScene, camera: Camera, cam_from_world: FloatArray, supersampling: int = 2
) -> FloatArray:
    """Render the image of a camera, before blur, noise and gamma.

    Args:
        scene: from `prepare`.
        camera: intrinsics, size and distortion.
        cam_from_world: (3, 4) pose; with a rolling shutter (height, 3, 4), one for each row.
        supersampling: rays per pixel in x and in y, >= 1; each has its own shadow ray.

    Returns:
        (height, width, 3) linear RGB, about 0..1.
    """
    total = np.zeros((camera.height * camera.width, 3))
    offsets = (np.arange(supersampling) + 0.5) / supersampling
    for dy in offsets:
        for dx in offsets:
            rays = pixel_rays(camera, (float(dx), float(dy)))
            shows = np.isfinite(rays[:, 0])
            center, directions = _to_world(np.where(shows[:, None], rays, [0.0, 0.0, 1.0]), cam_from_world)
            hits = cast_rays(scene.rays, center, directions)
            lit = _is_sunlit(scene, center, directions, hits)
            # t_hit is the z depth where rays have z = 1, else the distance; a pixel covers t_hit / f on the surface
            pixel = np.where(np.isfinite(hits["t_hit"]), hits["t_hit"], 1.0) / camera.K[0, 0]
            shade(
                (directions, hits["primitive_ids"], hits["primitive_uvs"], pixel, lit),
                (scene.faces, scene.vertex_table, scene.face_material, scene.materials, scene.lights),
                total,
            )
    total[~shows] = 0.0  # outside of the image circle
    return (total / supersampling**2).reshape(camera.height, camera.width, 3)


def _to_world(rays: FloatArray, cam_from_world: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the origin (3,) of rays (N, 3) of a photo, or one for each (N, 3), and their directions (N, 3)."""
    if cam_from_world.ndim == 2:
        return camera_center(cam_from_world), rays @ cam_from_world[:, :3]
    poses = np.repeat(cam_from_world, len(rays) // len(cam_from_world), axis=0)
    R = poses[:, :, :3]
    return -np.einsum("nji,nj->ni", R, poses[:, :, 3]), np.einsum("nj,nji->ni", rays, R)


def ray_caster(vertices: FloatArray, faces: NDArray[np.int64]) -> Any:
    """Return Open3D's RaycastingScene of one mesh, in single precision.

    Args:
        vertices: (V, 3).
        faces: (T, 3) vertex indices.
    """
    open3d = load_open3d()
    caster = open3d.t.geometry.RaycastingScene()
    tensor = open3d.core.Tensor
    caster.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    return caster


def cast_rays(caster: Any, origin: FloatArray, directions: FloatArray) -> dict[str, NDArray[Any]]:
    """Return the first hits of rays, by Open3D's names; t_hit is inf for rays that hit nothing.

    Args:
        caster: from `ray_caster`.
        origin: (3,), or (N, 3) one per ray.
        directions: (N, 3) of any length, which is the unit of t_hit.
    """
    rays = np.empty((len(directions), 6), dtype=np.float32)
    rays[:, :3] = origin
    rays[:, 3:] = directions
    found = caster.cast_rays(load_open3d().core.Tensor(rays))
    return {key: found[key].numpy() for key in ("t_hit", "primitive_ids", "primitive_uvs", "primitive_normals")}


def _is_sunlit(
    scene: PreparedScene, center: FloatArray, directions: FloatArray, hits: dict[str, NDArray[Any]]
) -> NDArray[np.bool_]:
    """Return whether the sun reaches each hit; shadow rays are cast only where the surface faces the sun."""
    sun = scene.lights[0]
    lit = hits["primitive_normals"] @ sun.astype(np.float32) > 0
    asked = np.flatnonzero(lit)
    rays = np.empty((len(asked), 6), dtype=np.float32)
    # a step towards the sun keeps the surface from shadowing itself
    origin = center if center.ndim == 1 else center[asked]
    rays[:, :3] = origin + directions[asked] * hits["t_hit"][asked, None] + 4e-3 * sun
    rays[:, 3:] = sun
    lit[asked] = ~scene.rays.test_occlusions(load_open3d().core.Tensor(rays)).numpy()
    return np.asarray(lit)


def _openness(caster: Any, vertices: FloatArray, normals: FloatArray) -> FloatArray:
    """Return the share of cosine-distributed rays (Fibonacci spiral) from each vertex that hit nothing nearby."""
    k = np.arange(AMBIENT_RAYS) + 0.5
    radius = np.sqrt(k / AMBIENT_RAYS)
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    u = np.cross(normals, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(normals, u)
    free = np.zeros(len(vertices))
    for r, a in zip(radius, angle, strict=True):
        direction = r * np.cos(a) * u + r * np.sin(a) * v + np.sqrt(1.0 - r * r) * normals
        distance = cast_rays(caster, vertices + 1e-2 * normals, direction)["t_hit"].astype(np.float64)
        free += np.clip(distance / 1.5, 0.0, 1.0)  # surfaces beyond 1.5 units do not darken
    return free / AMBIENT_RAYS


@kernel
def shade(hits: Any, tables: Any, total: NDArray[np.float64]) -> None:
    """Add the color of every ray to `total`.

    Args:
        hits: directions (N, 3), primitive ids (N,), barycentric uv (N, 2), pixel size there (N,), in sunlight (N,).
        tables: faces, vertex table, material per face, materials and lights of `PreparedScene`.
        total: (N, 3) linear RGB, changed in place.
    """
    directions, ids, uvs, pixel, lit = hits
    faces, vertex_table, face_material, materials, lights = tables
    at = np.empty(7)
    for i in range(len(ids)):
        if ids[i] == NO_HIT:
            d = directions[i]
            up = min(1.0, max(0.0, 2.5 * d[1] / np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])))
            for c in range(3):
                total[i, c] += lights[4, c] + (lights[3, c] - lights[4, c]) * np.sqrt(up)
            continue
        face = ids[i]
        u, v = uvs[i, 0], uvs[i, 1]
        for k in range(7):
            at[k] = (
                (1.0 - u - v) * vertex_table[faces[face, 0], k]
                + u * vertex_table[faces[face, 1], k]
                + v * vertex_table[faces[face, 2], k]
            )
        row = materials[face_material[face]]
        second, joint, bright = mixture(row, (at[3], at[4], at[5]), (at[0], at[1], at[2]), pixel[i])
        facing = at[0] * lights[0, 0] + at[1] * lights[0, 1] + at[2] * lights[0, 2]
        sun = max(0.0, facing) if lit[i] else 0.0
        sky = at[6] * (0.65 + 0.35 * at[1])
        for c in range(3):
            color = row[4 + c] + second * (row[7 + c] - row[4 + c])
            color += joint * (row[10 + c] - color)
            total[i, c] += color * bright * (sun * lights[1, c] + sky * lights[2, c])
