"""Shapes enclose what they should, and their colors have detail at every scale."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.synthetic import shapes

VASE = np.array([[0.0, 0.0], [0.3, 0.0], [0.2, 0.5], [0.4, 1.0], [0.0, 1.0]])


def signed_volume(shape):
    a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
    return float(np.sum(a * np.cross(b, c)) / 6)


def cone(bottom, top, height):
    return math.pi * height / 3 * (bottom**2 + bottom * top + top**2)


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        (shapes.box(1.0, 2.0, 3.0), 6.0),
        (shapes.box(1.0, 2.0, 3.0).move((5.0, -1.0, 2.0), turn_deg=20.0, tilt_deg=50.0), 6.0),
        (shapes.ball(0.5), math.pi / 6),
        (shapes.torus(1.0, 0.2), 2 * math.pi**2 * 0.04),
        (shapes.revolve(VASE, segments=200), cone(0.3, 0.2, 0.5) + cone(0.2, 0.4, 0.5)),
        (shapes.revolve(VASE, segments=200, sharp=True), cone(0.3, 0.2, 0.5) + cone(0.2, 0.4, 0.5)),
        (shapes.arch(1.0, 0.5, 0.4), math.pi / 2 * (1.5**2 - 1.0**2) * 0.4),  # its open feet lie in y = 0
    ],
    ids=["box", "moved box", "ball", "torus", "vase", "sharp vase", "arch"],
)
def test_triangles_enclose_the_right_volume_from_outside(shape, volume):
    assert signed_volume(shape) == pytest.approx(volume, rel=0.02)


@pytest.mark.parametrize(
    "shape", [shapes.box(1.0, 1.0, 1.0), shapes.ball(1.0), shapes.torus(1.0, 0.2), shapes.revolve(VASE, sharp=True)]
)
def test_normals_are_unit_and_point_as_the_triangles(shape):
    a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    face_normals = cross / np.linalg.norm(cross, axis=1, keepdims=True)
    assert np.allclose(np.linalg.norm(shape.normals, axis=1), 1.0)
    assert np.einsum("nc,nkc->nk", face_normals, shape.normals[shape.faces]).min() > 0.5


def egg(points):
    """Positive in an ellipsoid with the half axes 0.5, 1, 0.25 around (0.1, 0, 0), which holds the axis."""
    return 1.0 - (((points - [0.1, 0.0, 0.0]) / [0.5, 1.0, 0.25]) ** 2).sum(axis=1)


@pytest.mark.slow
def test_a_carved_body_is_what_its_field_says():
    shape = shapes.carve(egg, (-1.1, 1.1), reach=0.8)
    assert signed_volume(shape) == pytest.approx(4 / 3 * np.pi * 0.5 * 0.25, rel=0.02)
    sides = shape.vertices[np.hypot(shape.vertices[:, 0], shape.vertices[:, 2]) > 0]
    assert np.abs(egg(sides)).max() < 0.02, "every vertex lies on it"
    assert shape.vertices[:, 0].max() == pytest.approx(0.6, abs=0.005)
    assert shape.vertices[:, 0].min() == pytest.approx(-0.4, abs=0.005)


@pytest.mark.slow
def test_a_carved_body_is_closed():
    shape = shapes.carve(egg, (-1.1, 1.1), reach=0.8, rows=40, segments=24)
    _, whole = np.unique(np.round(shape.vertices, 9), axis=0, return_inverse=True)
    faces = whole.ravel()[shape.faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}


POINTS = np.random.default_rng(0).uniform(-3, 3, (400, 3))
UP = (0.0, 1.0, 0.0)
PLACES = st.floats(-100, 100)


@given(x=PLACES, y=PLACES, z=PLACES)
def test_noise_is_bounded_and_continuous(x, y, z):
    here, near = shapes.value_noise(x, y, z, 3), shapes.value_noise(x + 1e-6, y - 1e-6, z + 1e-6, 3)
    assert -1 <= here < 1 and abs(here - near) < 1e-4
    assert shapes.value_noise(4.0, -2.0, 7.0, 9) == pytest.approx(2 * shapes.lattice(4, -2, 7, 9) - 1)


def test_detail_below_a_pixel_is_left_out():
    coarse = np.array([shapes.octaves(tuple(p), 1.0, 0.7, 2.0, 1) for p in POINTS])
    medium = np.array([shapes.octaves(tuple(p), 1.0, 0.7, 0.2, 1) for p in POINTS])
    fine = np.array([shapes.octaves(tuple(p), 1.0, 0.7, 0.002, 1) for p in POINTS])
    assert not coarse.any() and 0.1 < medium.std() < fine.std() < 1.0


@pytest.mark.parametrize("pattern", shapes.PATTERNS)
def test_patterns_mix_within_range_and_vary(pattern):
    row = shapes.Material(pattern=pattern, base=(200, 10, 10), second=(10, 200, 10)).row(seed=100)
    other = shapes.Material(pattern=pattern, base=(200, 10, 10), second=(10, 200, 10)).row(seed=200)
    mixed = np.array([shapes.mixture(row, tuple(p), UP, 0.005) for p in POINTS])
    again = np.array([shapes.mixture(row, tuple(p), UP, 0.005) for p in POINTS])
    elsewhere = np.array([shapes.mixture(other, tuple(p), UP, 0.005) for p in POINTS])

    assert mixed[:, :2].min() >= 0 and mixed[:, :2].max() <= 1
    assert mixed[:, 2].min() > 0 and 0.7 < mixed[:, 2].mean() < 1.3
    assert mixed[:, 0].std() > 0.05 and mixed[:, 2].std() > 0.05 and np.array_equal(mixed, again)
    assert not np.allclose(mixed[:, 2], elsewhere[:, 2]), "two bodies of one material differ"
    assert row[:4].tolist() == [shapes.PATTERNS.index(pattern), 0.3, 0.5, 100]
    assert row[4:7] == pytest.approx((np.array([200, 10, 10]) / 255) ** 2.2), "colors are linear"


def test_masonry_turns_with_its_body():
    """The normal is that in the scene, the position that on the body: a turned house keeps its bricks."""
    row = shapes.Material(pattern="masonry", base=(150, 76, 56), second=(188, 116, 84), scale=0.2).row(7)
    found = np.array(
        [[shapes.mixture(row, tuple(p), n, 0.01) for p in POINTS] for n in ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))]
    )
    assert np.array_equal(found[0], found[1])
    assert 0.02 < (found[0][:, 1] > 0.5).mean() < 0.5, "joints between bricks"
