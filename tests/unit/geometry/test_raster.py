import numpy as np
import pytest

from sfm_app.geometry.raster import NOTHING, rasterize
from sfm_app.types import PosedPhoto

K = np.array([[100.0, 0.0, 32.0], [0.0, 100.0, 24.0], [0.0, 0.0, 1.0]])
PHOTO = PosedPhoto("", K, np.eye(3, 4), 64, 48)
TILTED = np.array([[-0.2, -0.2, 1.0], [0.0, 0.2, 1.2], [0.3, -0.1, 1.5]])
FRONT, BACK = np.array([[0, 1, 2]]), np.array([[0, 2, 1]])


def facing(vertices, faces):
    """Whether the first triangle turns its front to the camera."""
    a, b, c = vertices[faces[0]]
    return np.cross(b - a, c - a) @ a < 0


def test_pixels_inside_a_triangle_get_its_depth():
    faces = FRONT if facing(TILTED, FRONT) else BACK
    found = rasterize(TILTED, faces, PHOTO)

    i, j = np.nonzero(found.face == 0)
    assert 200 < len(i) < 900
    pixels = np.column_stack([j + 0.5, i + 0.5, np.ones(len(i))])
    place = found.depth[i, j, None] * (pixels @ np.linalg.inv(K).T)
    a, b, c = TILTED[faces[0]]
    assert (place - a) @ np.cross(b - a, c - a) == pytest.approx(0.0, abs=1e-6)
    assert np.isinf(found.depth[found.face == NOTHING]).all()


def test_the_back_of_a_triangle_hides_and_is_not_shown():
    faces = BACK if facing(TILTED, FRONT) else FRONT
    behind = 2.0 * (0.1 * TILTED.mean(axis=0) + 0.9 * TILTED)
    found = rasterize(np.concatenate([TILTED, behind]), np.concatenate([faces, 3 + faces[:, ::-1]]), PHOTO)

    assert (found.face == NOTHING).all()
    assert found.depth[np.isfinite(found.depth)].max() < 1.6


def test_the_nearest_triangle_is_shown():
    faces = FRONT if facing(TILTED, FRONT) else BACK
    both = np.concatenate([1.3 * TILTED, TILTED])
    found = rasterize(both, np.concatenate([faces, 3 + faces]), PHOTO)

    assert (found.face[found.face != NOTHING] == 1).all()


@pytest.mark.parametrize("off", [(0.0, 0.0, -3.0), (50.0, 0.0, 0.0), (0.0, 0.0, -1.2)])
def test_what_is_behind_or_beside_the_photo_is_not_drawn(off):
    found = rasterize(TILTED + off, FRONT, PHOTO)

    assert (found.face == NOTHING).all()
