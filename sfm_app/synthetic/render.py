"""Render scenes as a camera sees them, and pictures of finished models."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.meshing.ray_casting import load_open3d
from sfm_app.synthetic.cameras import Camera, pixel_rays
from sfm_app.synthetic.shapes import SyntheticScene, mixture
from sfm_app.types import Surface
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray
from sfm_app.types.scene import camera_center
from sfm_app.types.surface import Model, Texture

NO_HIT = 0xFFFFFFFF
GAMMA = 2.2
# linear RGB
SUNLIGHT = np.array([1.0, 0.93, 0.82])
SKYLIGHT = np.array([0.82, 0.92, 1.0])
ZENITH = np.array([0.20, 0.38, 0.72])
HORIZON = np.array([0.66, 0.76, 0.86])


@dataclass(frozen=True, slots=True, eq=False)
class PreparedScene:
    """A scene prepared for rendering many photos: ray-casting structure and shading tables."""

    rays: Any
    """Open3D RaycastingScene."""
    faces: IndexArray
    vertex_table: FloatArray
    """(V, 7): normal, texture coordinates, and the visible share of the sky (ambient occlusion)."""
    face_material: IndexArray
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
    """Return the image (height, width, 3) of a camera in linear RGB, about 0..1, before blur, noise and gamma.

    With a rolling shutter, each row has a pose: (height, 3, 4). Each ray of supersampling has its own shadow ray.
    """
    total = np.zeros((camera.height * camera.width, 3))
    offsets = (np.arange(supersampling) + 0.5) / supersampling
    for dy in offsets:
        for dx in offsets:
            rays = pixel_rays(camera, (float(dx), float(dy)))
            shows = np.isfinite(rays[:, 0])
            center, directions = _to_world(np.where(shows[:, None], rays, [0.0, 0.0, 1.0]), cam_from_world)
            hits = cast_rays(scene.rays, center, directions)
            lit = is_sunlit(scene, center, directions, hits)
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


def ray_caster(vertices: FloatArray, faces: IndexArray) -> Any:
    """Return Open3D's RaycastingScene of triangles (T, 3) of vertices (V, 3), in single precision."""
    open3d = load_open3d()
    caster = open3d.t.geometry.RaycastingScene()
    tensor = open3d.core.Tensor
    caster.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    return caster


def cast_rays(caster: Any, origin: FloatArray, directions: FloatArray) -> dict[str, NDArray[Any]]:
    """Return the first hits of rays, by Open3D's names; t_hit, in lengths of the directions, is inf without a hit."""
    rays = np.empty((len(directions), 6), dtype=np.float32)
    rays[:, :3] = origin
    rays[:, 3:] = directions
    hits = caster.cast_rays(load_open3d().core.Tensor(rays))
    return {key: hits[key].numpy() for key in ("t_hit", "primitive_ids", "primitive_uvs", "primitive_normals")}


def is_sunlit(
    scene: PreparedScene, center: FloatArray, directions: FloatArray, hits: dict[str, NDArray[Any]]
) -> BoolArray:
    """Return whether the sun reaches each hit; shadow rays are cast only where the surface faces the sun."""
    sun = scene.lights[0]
    lit = hits["primitive_normals"] @ sun.astype(np.float32) > 0
    rows = np.flatnonzero(lit)
    rays = np.empty((len(rows), 6), dtype=np.float32)
    # a step towards the sun keeps the surface from shadowing itself
    origin = center if center.ndim == 1 else center[rows]
    rays[:, :3] = origin + directions[rows] * hits["t_hit"][rows, None] + 4e-3 * sun
    rays[:, 3:] = sun
    lit[rows] = ~scene.rays.test_occlusions(load_open3d().core.Tensor(rays)).numpy()
    return np.asarray(lit)


def _openness(caster: Any, vertices: FloatArray, normals: FloatArray) -> FloatArray:
    """Return the share of cosine-distributed rays (Fibonacci spiral) from each vertex that hit nothing nearby."""
    count = 24
    k = np.arange(count) + 0.5
    radius = np.sqrt(k / count)
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
    return free / count


@kernel
def shade(hits: Any, tables: Any, total: FloatArray) -> None:
    """Add the color of every ray to `total`.

    Args:
        hits: directions (N, 3), primitive ids (N,), barycentric uv (N, 2), pixel size there (N,), in sunlight (N,).
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
        shine = row[13]
        room, glint = _reflect(directions[i], at, lights[0]) if shine > 0.0 else (0.0, 0.0)
        glint = glint if lit[i] else 0.0
        for c in range(3):
            color = row[4 + c] + second * (row[7 + c] - row[4 + c])
            color += joint * (row[10 + c] - color)
            light = (1.0 - shine) * sun + shine * glint, (1.0 - shine) * sky + shine * room
            total[i, c] += color * bright * (light[0] * lights[1, c] + light[1] * lights[2, c])


@kernel
def _reflect(direction: FloatArray, normal: FloatArray, to_sun: FloatArray) -> tuple[float, float]:
    """Return what a rough mirror shows of a room with windows around, and of the sun."""
    along, length = 0.0, 0.0
    for c in range(3):
        along += direction[c] * normal[c]
        length += direction[c] * direction[c]
    length = np.sqrt(length)
    x = (direction[0] - 2.0 * along * normal[0]) / length
    y = (direction[1] - 2.0 * along * normal[1]) / length
    z = (direction[2] - 2.0 * along * normal[2]) / length
    windows = 0.5 + 0.5 * np.sin(5.0 * np.arctan2(x, z))
    near_sun = max(0.0, x * to_sun[0] + y * to_sun[1] + z * to_sun[2])
    return 0.3 + 0.5 * max(0.0, y) + 0.6 * windows * (1.0 - abs(y)), 2.0 * near_sun**30


Colors = NDArray[np.uint8]
GRAY, INSIDE = np.array([205.0, 205.0, 205.0]), np.array([196.0, 120.0, 110.0])
"""Colors of the untextured shape in full light, seen from outside and from inside."""
LAMP = np.array([-0.45, -0.65, -1.0]) / np.linalg.norm([-0.45, -0.65, -1.0])
"""Direction from a face to the lamp, in the camera's frame: over the photographer's left shoulder."""


class PreparedModel:
    """A model with its ray-casting structure, built once for all pictures."""

    def __init__(self, model: Model) -> None:
        self.model, self.rays = model, ray_caster(model.surface.vertices, model.surface.faces)


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A rendered picture of a model."""

    colors: Colors
    """(H, W, 3) RGB; 0 where the model is not visible."""
    covered: BoolArray
    """(H, W), whether the model is visible."""

    def with_background(self, background: tuple[int, int, int] = (255, 255, 255)) -> Colors:
        """Return (H, W, 3) with a background color where the model is not visible."""
        return np.where(self.covered[..., None], self.colors, np.array(background, np.uint8))


def render_model(prepared: PreparedModel, camera: Camera, cam_from_world: FloatArray) -> Picture:
    """Render the model at a pose (3, 4), unlit in the colors of its texture or vertices, from both sides."""
    directions = pixel_rays(camera) @ cam_from_world[:, :3]
    return render_rays(prepared, camera_center(cam_from_world), directions.reshape(camera.height, camera.width, 3))


def render_rays(prepared: PreparedModel, origin: FloatArray, directions: FloatArray) -> Picture:
    """Render as `render_model` does, with rays from one origin (3,) and a direction (H, W, 3) per pixel."""
    shape = directions.shape[:2]
    hits = cast_rays(prepared.rays, origin, directions.reshape(-1, 3))
    covered = np.isfinite(hits["t_hit"]).reshape(shape)
    if not covered.any():
        return Picture(np.zeros((*shape, 3), np.uint8), covered)
    face = np.where(covered, hits["primitive_ids"].reshape(shape), 0).astype(np.int64)
    uv = hits["primitive_uvs"].reshape(*shape, 2).astype(np.float64)
    weights = np.concatenate([1.0 - uv.sum(axis=-1, keepdims=True), uv], axis=-1)
    surface, texture = prepared.model.surface, prepared.model.texture
    if texture is None:
        corners = surface.colors[surface.faces[face]].astype(np.float64)
        colors = np.asarray(np.round(np.einsum("hwk,hwkc->hwc", weights, corners)))
    else:
        colors = _texture_colors(texture, face, weights)
    return Picture(np.where(covered[..., None], colors, 0).astype(np.uint8), covered)


def render_shape(prepared: PreparedModel, camera: Camera, cam_from_world: FloatArray) -> Picture:
    """Render the untextured shape at a pose (3, 4) in gray with flat shading; reddish from inside."""
    shape, R = (camera.height, camera.width), cam_from_world[:, :3]
    directions = pixel_rays(camera) @ R
    hits = cast_rays(prepared.rays, camera_center(cam_from_world), directions)
    normals = hits["primitive_normals"].astype(np.float64)
    inside = (normals * directions).sum(axis=1) > 0
    facing = np.abs(normals @ (LAMP @ R))
    light = 0.25 + 0.75 * np.where(np.isfinite(facing), facing, 0.0)
    covered = np.isfinite(hits["t_hit"])
    colors = light[:, None] * np.where(inside[:, None], INSIDE, GRAY) * covered[:, None]
    return Picture(np.round(colors).astype(np.uint8).reshape(*shape, 3), covered.reshape(shape))


def comparison_image(photo: Colors, prepared: PreparedModel, camera: Camera, cam_from_world: FloatArray) -> Colors:
    """Return a photo and the model from its camera, RGB; below, the model and its untextured shape from the side."""
    size = camera.width, camera.height
    fine = Camera(np.diag([2, 2, 1.0]) @ camera.K, 2 * size[0], 2 * size[1], camera.lens)
    aside = orbited_pose(cam_from_world, prepared.model.surface, 25.0)
    views = [
        photo,
        render_model(prepared, fine, cam_from_world).with_background(),
        render_model(prepared, fine, aside).with_background(),
        render_shape(prepared, fine, aside).with_background(),
    ]
    a, b, c, d = (np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_AREA), np.uint8) for view in views)
    return np.concatenate([np.concatenate([a, b], axis=1), np.concatenate([c, d], axis=1)])


def orbited_pose(pose: FloatArray, surface: Surface, angle_deg: float) -> FloatArray:
    """Return a pose (3, 4) rotated about the vertical axis through the surface in view, in a frame with y up."""
    R, t = pose[:, :3], pose[:, 3]
    depth = float(np.median(surface.vertices @ R[2] + t[2]))
    middle = R.T @ (np.array([0.0, 0.0, depth]) - t)
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turned = R @ np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return np.column_stack([turned, R @ middle + t - turned @ middle])


def _texture_colors(texture: Texture, face: IndexArray, weights: FloatArray) -> Colors:
    """Sample the texture bilinearly; texel centers at +0.5, the border repeated."""
    place = np.einsum("hwk,hwkc->hwc", weights, texture.uv[face].astype(np.float64))
    page_of = texture.page[face]
    colors = np.zeros((*face.shape, 3), np.uint8)
    for number, page in enumerate(texture.pages):
        here = page_of == number
        if here.any():
            at = (place * [page.shape[1], page.shape[0]] - 0.5).astype(np.float32)
            samples = cv2.remap(page, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            colors[here] = samples[here]
    return colors
