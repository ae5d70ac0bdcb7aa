"""Volumes of heaps and pits of known shape: values, and deviations that cover the error and are not much too wide."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.frame.sighted_points import Sightlines, place_covariance
from sfm_app.frame.volumes import measure_volume
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.types import Surface

SQUARE = np.array([[-2.0, 0.0, 2.0], [2.0, 0.0, 2.0], [2.0, 0.0, -2.0], [-2.0, 0.0, -2.0]])
HALF = 2.5
"""Half of the side of the ground, in meters."""
CONE = np.pi * 1.2**2 * 0.9 / 3
"""Volume of the heap."""


def ground(height, cells=160, hole=None):
    """A surface of heights over x and z, its triangles counterclockwise from above; without faces in a hole."""
    x, z = np.meshgrid(np.linspace(-HALF, HALF, cells + 1), np.linspace(-HALF, HALF, cells + 1))
    vertices = np.stack([x, height(x, z), z], axis=-1).reshape(-1, 3)
    at = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    if hole is not None:
        middles = vertices[faces].mean(axis=1)
        faces = faces[~hole(middles[:, 0], middles[:, 2])]
    return Surface(vertices, faces.astype(np.int32), np.zeros((len(vertices), 3), np.uint8))


def cone(x, z, sign=1.0):
    return sign * np.maximum(0.9 * (1 - np.hypot(x, z) / 1.2), 0.0)


def flight(focal=1000.0):
    """Nine cameras six meters above, and points that all of them see."""
    centers = np.array([[x, 6.0, z] for x in (-2.0, 0.0, 2.0) for z in (-2.0, 0.0, 2.0)])
    points = np.random.default_rng(0).uniform([-HALF, 0.0, -HALF], [HALF, 0.1, HALF], size=(300, 3))
    return Sightlines(centers, np.full(9, focal), points, tuple(np.arange(9) for _ in points), 0.5)


def test_heaps_and_pits_of_known_volume_are_measured():
    heap = measure_volume(SQUARE, ground(cone), flight(), 1e-4)
    assert heap.cut == pytest.approx(CONE, rel=1e-3) and heap.fill < 1e-6 and heap.missing == 0.0
    assert heap.area == pytest.approx(16.0) and heap.metric
    pit = measure_volume(SQUARE, ground(lambda x, z: cone(x, z, -1.0)), flight(), None)
    assert pit.fill == pytest.approx(CONE, rel=1e-3) and pit.cut < 1e-6 and not pit.metric
    assert pit.net == pytest.approx(-CONE, rel=1e-3)


def test_a_heap_beside_a_pit_has_both():
    both = measure_volume(SQUARE, ground(lambda x, _: 0.3 * np.sin(np.pi * x)), flight(), 1e-4)
    assert both.cut == pytest.approx(16 * 0.3 / np.pi, rel=2e-3)
    assert both.fill == pytest.approx(both.cut, rel=2e-3) and abs(both.net) < 1e-3


def test_the_polygon_bounds_what_counts_and_may_be_concave():
    corner = np.array([[-2, 0, 2], [2, 0, 2], [2, 0, 0], [0, 0, 0], [0, 0, -2], [-2, 0, -2]], float)
    found = measure_volume(corner, ground(cone), flight(), 1e-4)
    assert found.cut == pytest.approx(CONE * 3 / 4, rel=2e-3) and found.area == pytest.approx(12.0)


def test_the_plane_may_be_tilted_and_the_order_of_corners_is_free():
    turn = axis_rotation(np.array([1.0, 0.0, 0.0]), 70.0)
    shape, model = ground(cone), flight()
    moved = Surface(shape.vertices @ turn.T, shape.faces, shape.colors)
    seen = Sightlines(model.centers @ turn.T, model.focals, model.points @ turn.T, model.seen_by, 0.5)
    for corners in (SQUARE, SQUARE[::-1]):
        found = measure_volume(corners @ turn.T, moved, seen, 1e-4)
        assert found.cut == pytest.approx(CONE, rel=1e-3) and found.fill < 1e-6


def test_what_stands_beside_or_below_does_not_count():
    shape = ground(cone)
    floor = Surface(shape.vertices - [0.0, 3.0, 0.0], shape.faces, shape.colors)
    two = Surface(np.concatenate([floor.vertices, shape.vertices]),
                  np.concatenate([floor.faces, shape.faces + len(floor.vertices)]),
                  np.concatenate([floor.colors, shape.colors]))  # fmt: skip
    assert measure_volume(SQUARE, two, flight(), 1e-4).fill < 1e-6


@pytest.mark.parametrize(("x", "radius"), [(0.0, 0.4), (0.6, 0.5), (1.6, 0.3)])
def test_a_hole_is_named_and_the_deviation_covers_it(x, radius):
    found = measure_volume(SQUARE, ground(cone, hole=lambda a, b: np.hypot(a - x, b) < radius), flight(1e5), 0.0)
    assert found.missing == pytest.approx(np.pi * radius**2 / 16, rel=0.1)
    whole = measure_volume(SQUARE, ground(cone), flight(1e5), 0.0)
    assert abs(found.cut - CONE) < found.cut_deviation < 0.5 * CONE
    assert found.cut_deviation > 3 * whole.cut_deviation


def test_the_deviation_covers_the_errors_of_surface_and_corners_and_size():
    """All of the surface is off by one depth error, and each corner by its own."""
    rng, model, normalized = np.random.default_rng(1), flight(), []
    for _ in range(40):
        covariance = place_covariance(np.zeros(3), model)
        sigma, size = np.sqrt(covariance[1, 1]), np.exp(0.002 * rng.normal())
        shift = sigma * rng.normal()
        corners = SQUARE + rng.multivariate_normal(np.zeros(3), covariance, size=4)
        shape = ground(lambda x, z, shift=shift: cone(x, z) + 0.05 + shift, cells=40)
        found = measure_volume(size * corners, Surface(size * shape.vertices, shape.faces, shape.colors), model, 0.002)
        normalized.append((found.net - (CONE + 16 * 0.05)) / found.net_deviation)
    assert 0.5 < np.sqrt(np.mean(np.square(normalized))) < 1.3


def test_the_unit_widens_the_deviation_by_three_times_its_own():
    sure, unsure = (measure_volume(SQUARE, ground(cone, cells=40), flight(), one) for one in (0.0, 0.05))
    assert np.hypot(sure.cut_deviation, 0.15 * sure.cut) == pytest.approx(unsure.cut_deviation)


def test_where_a_heap_stands_across_the_edge_the_places_of_corners_count():
    model, rng = flight(), np.random.default_rng(2)
    model = replace(model, centers=10 * model.centers)  # the height of the heap hardly changes its distance
    flat, mesa = (measure_volume(SQUARE, ground(lambda x, _, h=h: h + 0 * x, cells=10), model, 0.0) for h in (0.0, 3.0))
    aside = np.sqrt(np.diag(place_covariance(SQUARE[0], model)))[[0, 2]]
    moved = SQUARE[:, [0, 2]] + aside * rng.normal(size=(400, 4, 2))
    x, y = np.moveaxis(moved, -1, 0)
    areas = np.abs((x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)) / 2
    edge = np.sqrt(mesa.net_deviation**2 - flat.net_deviation**2)
    assert 0.9 < edge / (3.0 * np.std(areas)) < 2.0


@pytest.mark.parametrize(
    ("corners", "says"),
    [
        (SQUARE[:2], "three or more corners"),
        (SQUARE[[0, 1, 1]], "on a line"),
        (SQUARE[[0, 2, 1, 3]], "cross"),
        (SQUARE + np.array([30.0, 0.0, 0.0]), "no surface in the polygon"),
    ],
)
def test_what_is_no_polygon_is_said(corners, says):
    with pytest.raises(ValueError, match=says):
        measure_volume(corners, ground(cone, cells=10), flight(), None)
