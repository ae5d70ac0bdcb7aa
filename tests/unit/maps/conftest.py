"""A house on flat ground, whose colors are the coordinates: every pixel of a map tells where it should lie."""

import numpy as np
import pytest

from sfm_app.frame.scale import MetricFrame
from sfm_app.numerical import json_text
from sfm_app.pipeline import NAMES, SCALE, TEXTURE
from sfm_app.products import write_texture
from sfm_app.runtime.workspace import StageRecord, Workspace
from sfm_app.types import Model, Surface, Texture

GROUND, ROOF, WALL = 200, 50, 120
"""Blue of each part; red and green are x and z of the ground and the roof."""
HALF, TALL = 4.0, 3.0
HOUSE = ((-1.0, 1.5), (-2.0, 0.5))
"""From and to along x, and along z; the ground is HALF to each side."""
PAGE = 256


def rectangle(corners):
    """Four corners, counterclockwise from outside, as two triangles."""
    return np.array(corners, np.float64), np.array([[0, 1, 2], [0, 2, 3]])


def house_model():
    """The house from outside, open below; its wall at +z is red from left to right."""
    (x0, x1), (z0, z1) = HOUSE
    far = HALF
    parts = [
        (rectangle([(-far, 0, far), (far, 0, far), (far, 0, -far), (-far, 0, -far)]), 0),
        (rectangle([(x0, TALL, z1), (x1, TALL, z1), (x1, TALL, z0), (x0, TALL, z0)]), 1),
        (rectangle([(x0, 0, z1), (x1, 0, z1), (x1, TALL, z1), (x0, TALL, z1)]), 2),
        (rectangle([(x1, 0, z0), (x0, 0, z0), (x0, TALL, z0), (x1, TALL, z0)]), 2),
        (rectangle([(x1, 0, z1), (x1, 0, z0), (x1, TALL, z0), (x1, TALL, z1)]), 2),
        (rectangle([(x0, 0, z0), (x0, 0, z1), (x0, TALL, z1), (x0, TALL, z0)]), 2),
    ]
    vertices = np.concatenate([corners for (corners, _), _ in parts])
    faces = np.concatenate([4 * k + triangles for k, ((_, triangles), _) in enumerate(parts)])
    page = np.repeat([number for _, number in parts], 2).astype(np.int32)
    corners = vertices[faces]
    uv = 0.5 + corners[:, :, [0, 2]] / (2.0 * HALF)
    walls = page == 2
    uv[walls] = 0.5 + corners[walls][:, :, [0, 1]] / (2.0 * HALF)
    ramp = np.arange(PAGE, dtype=np.uint8)
    pages = []
    for blue in (GROUND, ROOF, WALL):
        picture = np.full((PAGE, PAGE, 3), blue, np.uint8)
        picture[:, :, 0], picture[:, :, 1] = ramp[None, :], ramp[:, None]
        pages.append(picture)
    surface = Surface(vertices, faces, np.zeros((len(vertices), 3), np.uint8))
    return Model(surface, Texture(uv.astype(np.float32), page, tuple(pages)))


def gray_of(coordinate):
    """Red or green at a coordinate."""
    return PAGE * (0.5 + coordinate / (2.0 * HALF)) - 0.5


@pytest.fixture
def house():
    return house_model()


@pytest.fixture
def make_run(tmp_path):
    """Makes a finished run of the house in a frame; returns its folder."""

    def make(frame=None, model=None, texels_per_pixel=1.0):
        place = Workspace(tmp_path / "out")
        write_texture(model or house_model(), place)
        place.scale.write_text(json_text((frame or MetricFrame()).to_dict()), encoding="utf-8")
        place.scene.write_text("{}", encoding="utf-8")
        for name in NAMES[: NAMES.index("texture") + 1]:
            stage = {"scale": SCALE, "texture": TEXTURE}.get(name)
            counts = {"scale": texels_per_pixel} if stage is TEXTURE else {}
            record = StageRecord("", 0.0, counts, digest=stage.digest(place) if stage else "")
            place.manifest.finish(name, record, {})
        return place.root

    return make
