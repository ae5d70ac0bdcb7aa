"""A textured relief before three cameras, rendered through its height field."""

from dataclasses import dataclass

import numpy as np

from sfm_app.meshing.agreement import RefinePhoto
from sfm_app.synthetic import shapes
from sfm_app.synthetic.cameras import look_at
from sfm_app.types import PosedPhoto, Surface

SIDE = 160
FOCAL_PX = 320.0
EYES = ((-0.5, 0.05, 2.0), (0.1, -0.1, 2.1), (0.6, 0.1, 1.9))
PIXEL = 2.0 / FOCAL_PX
"""Size of a pixel on the surface."""


def gray_at(x, y):
    """A smooth texture with detail of some pixels."""
    rng = np.random.default_rng(5)
    value = np.zeros_like(x)
    for vector, phase in zip(rng.normal(size=(30, 2)) * 90.0, rng.uniform(0, 6.3, 30), strict=True):
        value += np.cos(vector[0] * x + vector[1] * y + phase)
    return 128.0 + 12.0 * value


def grid(height, half=0.42, step=2.0 * PIXEL):
    """A relief as triangles that face +z."""
    line = np.arange(-half, half + step / 2, step)
    places, faces = shapes.grid(line, line)
    return Surface(np.column_stack([places, height(*places.T)]), faces, np.full((len(places), 3), 128, np.uint8))


def photo_of(eye, height):
    pose = look_at(np.array(eye), np.zeros(3))
    R, t = pose[:, :3], pose[:, 3]
    K = np.array([[FOCAL_PX, 0.0, SIDE / 2], [0.0, FOCAL_PX, SIDE / 2], [0.0, 0.0, 1.0]])
    v, u = np.indices((SIDE, SIDE)) + 0.5
    rays = np.stack([(u - SIDE / 2) / FOCAL_PX, (v - SIDE / 2) / FOCAL_PX, np.ones_like(u)], -1) @ R
    center = -R.T @ t
    place = center + rays * (-center[2] / rays[..., 2:])
    for _ in range(30):  # fixed point: the height of the place that the ray meets
        place = center + rays * ((height(place[..., 0], place[..., 1]) - center[2]) / rays[..., 2])[..., None]
    gray = gray_at(place[..., 0], place[..., 1])
    return RefinePhoto(PosedPhoto("", K, pose, SIDE, SIDE), np.clip(np.round(gray), 0, 255).astype(np.uint8))


@dataclass(frozen=True)
class Relief:
    height: object
    photos: list
    partners: list


def relief(height):
    """Photos of a height field."""
    return Relief(height, [photo_of(eye, height) for eye in EYES], [[1, 2], [0, 2], [0, 1]])
