"""Render pictures of a finished model: in its own colors, untextured in gray, or next to a photo."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.synthetic.cameras import Camera, camera_center, pixel_rays
from sfm_app.synthetic.render import cast_rays, ray_caster
from sfm_app.types import Surface
from sfm_app.types.model import Model, Texture

FloatArray = NDArray[np.float64]
Colors = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]
GRAY, INSIDE = np.array([205.0, 205.0, 205.0]), np.array([196.0, 120.0, 110.0])
"""Colors of the untextured shape in full light, seen from outside and from inside."""
AMBIENT = 0.25
"""Ambient light on the untextured shape, 0..1."""
LAMP = np.array([-0.45, -0.65, -1.0]) / np.linalg.norm([-0.45, -0.65, -1.0])
"""Direction from a face to the lamp, in the camera's frame: over the photographer's left shoulder."""
SIDE_VIEW_DEG = 25.0
"""Angle between the view of the photo and the side view."""
SUPERSAMPLING = 2
"""Supersampling factor, in x and in y, of the pictures next to a photo."""


@dataclass(frozen=True, slots=True, eq=False)
class PreparedModel:
    """A model prepared for rendering many pictures."""

    model: Model
    rays: Any
    """Open3D RaycastingScene; None if there are no triangles."""


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


def prepare_model(model: Model) -> PreparedModel:
    """Build the ray-casting structure once for all pictures."""
    surface = model.surface
    return PreparedModel(model, ray_caster(surface.vertices, surface.faces) if len(surface.faces) else None)


def render_model(model: Model | PreparedModel, camera: Camera, cam_from_world: FloatArray) -> Picture:
    """Render the model unlit in its own colors: its texture, or its vertex colors if it has no texture.

    Triangles are visible from both sides. Each pixel is sampled once at its center, so a texture much finer than the
    pixels causes aliasing.

    Args:
        model: in the frame of `cam_from_world`.
        camera: intrinsics, size and distortion.
        cam_from_world: (3, 4) pose.
    """
    directions = pixel_rays(camera) @ cam_from_world[:, :3]
    return render_rays(model, camera_center(cam_from_world), directions.reshape(camera.height, camera.width, 3))


def render_rays(model: Model | PreparedModel, origin: FloatArray, directions: FloatArray) -> Picture:
    """Render as `render_model` does, for any lens, with one given ray per pixel.

    Args:
        model: in the frame of the rays.
        origin: (3,) where all rays start.
        directions: (H, W, 3) of any length, one per pixel.
    """
    prepared = model if isinstance(model, PreparedModel) else prepare_model(model)
    shape = directions.shape[:2]
    if prepared.rays is None:
        return Picture(np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.bool_))
    hits = cast_rays(prepared.rays, origin, directions.reshape(-1, 3))
    covered = np.isfinite(hits["t_hit"]).reshape(shape)
    face = np.where(covered, hits["primitive_ids"].reshape(shape), 0).astype(np.int64)
    uv = hits["primitive_uvs"].reshape(*shape, 2).astype(np.float64)
    weights = np.concatenate([1.0 - uv.sum(axis=-1, keepdims=True), uv], axis=-1)
    surface, texture = prepared.model.surface, prepared.model.texture
    colors = _vertex_colors(surface, face, weights) if texture is None else _texture_colors(texture, face, weights)
    return Picture(np.where(covered[..., None], colors, 0).astype(np.uint8), covered)


def render_shape(model: Model | PreparedModel, camera: Camera, cam_from_world: FloatArray) -> Picture:
    """Render the untextured shape in gray with flat shading, so that every bump shows; reddish from inside.

    Args:
        model: in the frame of `cam_from_world`.
        camera: intrinsics, size and distortion.
        cam_from_world: (3, 4) pose.
    """
    prepared = model if isinstance(model, PreparedModel) else prepare_model(model)
    shape = camera.height, camera.width
    if prepared.rays is None:
        return Picture(np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.bool_))
    R = cam_from_world[:, :3]
    directions = pixel_rays(camera) @ R
    hits = cast_rays(prepared.rays, camera_center(cam_from_world), directions)
    normals = hits["primitive_normals"].astype(np.float64)
    inside = (normals * directions).sum(axis=1) > 0
    facing = np.abs(normals @ (LAMP @ R))
    light = AMBIENT + (1.0 - AMBIENT) * np.where(np.isfinite(facing), facing, 0.0)
    covered = np.isfinite(hits["t_hit"])
    colors = light[:, None] * np.where(inside[:, None], INSIDE, GRAY) * covered[:, None]
    return Picture(np.round(colors).astype(np.uint8).reshape(*shape, 3), covered.reshape(shape))


def comparison_image(photo: Colors, model: Model | PreparedModel, camera: Camera, cam_from_world: FloatArray) -> Colors:
    """Return a photo and the model from its camera; below, the model and its untextured shape from the side.

    Args:
        photo: (h, w, 3) RGB; resized to the camera's size.
        model: in the frame of `cam_from_world`, with y up.
        camera: intrinsics and distortion, and the size of each of the four pictures.
        cam_from_world: (3, 4) pose.

    Returns:
        (2 height, 2 width, 3) RGB.
    """
    prepared = model if isinstance(model, PreparedModel) else prepare_model(model)
    size = camera.width, camera.height
    fine = Camera(
        np.diag([SUPERSAMPLING, SUPERSAMPLING, 1.0]) @ camera.K,
        SUPERSAMPLING * size[0],
        SUPERSAMPLING * size[1],
        camera.lens,
    )
    aside = orbited_pose(cam_from_world, prepared.model.surface, SIDE_VIEW_DEG)
    views = [
        photo,
        render_model(prepared, fine, cam_from_world).with_background(),
        render_model(prepared, fine, aside).with_background(),
        render_shape(prepared, fine, aside).with_background(),
    ]
    a, b, c, d = (np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_AREA), np.uint8) for view in views)
    return np.concatenate([np.concatenate([a, b], axis=1), np.concatenate([c, d], axis=1)])


def orbited_pose(pose: FloatArray, surface: Surface, angle_deg: float) -> FloatArray:
    """Return a camera pose rotated about the vertical axis through the surface it looks at, in a frame with y up.

    Args:
        pose: (3, 4) cam_from_world of that camera.
        surface: its median depth gives the center of rotation on the optical axis.
        angle_deg: degrees about y.
    """
    R, t = pose[:, :3], pose[:, 3]
    depth = float(np.median(surface.vertices @ R[2] + t[2]))
    middle = R.T @ (np.array([0.0, 0.0, depth]) - t)
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turned = R @ np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return np.column_stack([turned, R @ middle + t - turned @ middle])


def _vertex_colors(surface: Surface, face: NDArray[np.int64], weights: FloatArray) -> FloatArray:
    corners = surface.colors[surface.faces[face]].astype(np.float64)
    return np.asarray(np.round(np.einsum("hwk,hwkc->hwc", weights, corners)))


def _texture_colors(texture: Texture, face: NDArray[np.int64], weights: FloatArray) -> Colors:
    """Sample the texture bilinearly; texel centers at +0.5, the border repeated."""
    place = np.einsum("hwk,hwkc->hwc", weights, texture.uv[face].astype(np.float64))
    page_of = texture.page[face]
    found = np.zeros((*face.shape, 3), np.uint8)
    for number, page in enumerate(texture.pages):
        here = page_of == number
        if here.any():
            at = (place * [page.shape[1], page.shape[0]] - 0.5).astype(np.float32)
            seen = cv2.remap(page, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            found[here] = seen[here]
    return found
