"""Points with lines of sight become the surface between free and full space."""

import numpy as np
import pytest

from sfm_app.geometry.triangles import areas, split_fans, unique_edges
from sfm_app.meshing.tetrahedra import Cloud, Sights, choose_sights, cut_surface, thin
from sfm_app.synthetic.shapes import grid

STEP = 0.1
CENTERS = 4.0 * np.array(
    [[np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)] for e in (-1.2, -0.4, 0.4, 1.2) for a in range(6)]
)


def ball_points(noise):
    """Points about STEP apart on the unit ball, and their normals."""
    count = round(4.0 * np.pi / STEP**2)
    height, turn = 1.0 - (2.0 * np.arange(count) + 1.0) / count, np.pi * (1.0 + 5.0**0.5) * np.arange(count)
    width = np.sqrt(1.0 - height**2)
    normals = np.column_stack([width * np.cos(turn), width * np.sin(turn), height])
    return normals * (1.0 + noise * np.random.default_rng(0).normal(size=(count, 1))), normals


def cloud_of(points, normals):
    colors = np.random.default_rng(1).integers(0, 256, points.shape).astype(np.uint8)
    return Cloud(points, normals, colors, STEP * np.random.default_rng(2).uniform(0.9, 1.1, len(points)))


def photos_that_face(cloud):
    """The points that each photo sees from before."""
    rays = CENTERS[:, None] - cloud.points
    return [np.flatnonzero(row) for row in (rays * cloud.normals).sum(axis=2) > 0.2 * np.linalg.norm(rays, axis=2)]


def span(cloud):
    return cut_surface(cloud, choose_sights(photos_that_face(cloud), CENTERS, len(cloud.points)))[0]


def assert_manifold(surface):
    """No two triangles run along an edge in the same direction, and every vertex has one fan."""
    edges = np.concatenate([surface.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert len(split_fans(surface).vertices) == len(surface.vertices)


def assert_closed(surface):
    assert_manifold(surface)
    edges, edge_of = unique_edges(surface.faces)
    assert np.array_equal(np.bincount(edge_of.ravel()), np.full(len(edges), 2))


def euler_number(surface):
    return len(surface.vertices) - len(unique_edges(surface.faces)[0]) + len(surface.faces)


def volume(surface):
    return np.linalg.det(surface.vertices[surface.faces]).sum() / 6.0


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.02])
def test_a_ball_seen_from_all_sides_is_closed_and_oriented(noise):
    """Without noise, all points lie on one sphere, and Delaunay's tetrahedra are not unique."""
    cloud = cloud_of(*ball_points(noise))

    found = span(cloud)

    assert_closed(found)
    assert euler_number(found) == 2
    assert volume(found) == pytest.approx(4.0 / 3.0 * np.pi, rel=0.02)
    assert areas(found.vertices, found.faces).sum() == pytest.approx(4.0 * np.pi, rel=0.01 if noise < 0.01 else 0.1)
    assert len(found.vertices) > 0.9 * len(cloud.points)


def test_place_and_size_do_not_matter():
    points, normals = ball_points(0.002)
    cloud, to = cloud_of(points, normals), np.array([4e5, -3e3, 50.0])
    moved = Cloud(1e3 * points + to, normals, cloud.colors, 1e3 * cloud.step)
    seen = photos_that_face(cloud)

    found, _ = cut_surface(moved, choose_sights(seen, 1e3 * CENTERS + to, len(points)))

    assert len(found.faces) == pytest.approx(len(span(cloud).faces), rel=0.01)
    assert_closed(found)


def test_vertices_are_points_with_their_colors_and_steps():
    cloud = cloud_of(*ball_points(0.02))

    found, step = cut_surface(cloud, choose_sights(photos_that_face(cloud), CENTERS, len(cloud.points)))

    number = {point.tobytes(): k for k, point in enumerate(cloud.points)}
    at = [number[vertex.tobytes()] for vertex in found.vertices]
    np.testing.assert_array_equal(found.colors, cloud.colors[at])
    np.testing.assert_array_equal(step, cloud.step[at])


def test_the_same_input_gives_the_same_bytes_and_stays_as_it_is():
    cloud = cloud_of(*ball_points(0.02))
    sights = choose_sights(photos_that_face(cloud), CENTERS, len(cloud.points))
    before = [part.tobytes() for part in (cloud.points, cloud.step, *sights)]

    (first, step), (again, same) = cut_surface(cloud, sights), cut_surface(cloud, sights)

    assert first.vertices.tobytes() == again.vertices.tobytes() and first.faces.tobytes() == again.faces.tobytes()
    assert step.tobytes() == same.tobytes()
    assert [part.tobytes() for part in (cloud.points, cloud.step, *sights)] == before


def test_a_point_inside_that_photos_claim_to_see_does_not_dent_the_ball():
    points, normals = ball_points(0.002)
    cloud = cloud_of(np.concatenate([points, [[0.1, 0.2, 0.5]]]), np.concatenate([normals, [[0.0, 0.0, 1.0]]]))

    found = span(cloud)

    assert np.linalg.norm(found.vertices, axis=1).min() > 0.95
    assert volume(found) == pytest.approx(4.0 / 3.0 * np.pi, rel=0.02)


def square(width, axis, at, side):
    """Points STEP apart on a square around an axis, with the normal along the axis to a side (-1 or 1)."""
    steps = round(width / STEP)
    places, _ = grid(np.linspace(0.0, width, steps + 1), np.linspace(0.0, width, steps + 1))
    normal = np.zeros(3)
    normal[axis] = side
    return np.insert(places, axis, at, axis=1), np.tile(normal, (len(places), 1))


@pytest.mark.parametrize("thickness", [0.5, 1.0])
def test_a_thin_plate_seen_from_both_sides_survives(thickness):
    """`thickness` is in distances of the points; there are none on the rim."""
    places, _ = grid(*[np.linspace(-1.0, 1.0, round(2.0 / STEP) + 1)] * 2)
    sides = [np.column_stack([places, np.full(len(places), z)]) for z in (0.0, thickness * STEP)]
    points = np.concatenate(sides) + 0.02 * STEP * np.random.default_rng(0).normal(size=(2 * len(places), 3))

    found = span(cloud_of(points, np.repeat([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], len(places), axis=0)))

    corners = found.vertices[found.faces]
    shadow = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    for side, z in ((shadow < 0.0, 0.0), (shadow > 0.0, thickness * STEP)):
        assert np.abs(shadow[side]).sum() == pytest.approx(4.0, rel=0.05)
        distance = np.abs(corners[side, :, 2] - z).mean(axis=1)
        assert np.average(distance, weights=np.abs(shadow[side])) < 0.05 * STEP


def two_balls(gap, turn):
    """The surface of two balls one above the other that hide parts of each other; the second one is turned (3, 3)."""
    points, normals = ball_points(0.002)
    middle = np.array([0.0, 0.0, 1.0 + 0.5 * gap])
    cloud = cloud_of(
        np.concatenate([points + middle, points @ turn - middle]), np.concatenate([normals, normals @ turn])
    )
    is_first, seen = np.arange(len(cloud.points)) < len(points), list[np.ndarray]()
    for center in 2.0 * CENTERS:
        ray = center - cloud.points
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        to_other = np.where(is_first[:, None], -middle, middle) - cloud.points
        ahead = (to_other * ray).sum(axis=1)
        is_hidden = (ahead > 0.0) & (np.linalg.norm(to_other - ahead[:, None] * ray, axis=1) < 1.0)
        seen.append(np.flatnonzero(((ray * cloud.normals).sum(axis=1) > 0.2) & ~is_hidden))
    return cut_surface(cloud, choose_sights(seen, 2.0 * CENTERS, len(cloud.points)))[0]


TURN = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]


def test_balls_a_step_apart_are_two_and_balls_that_touch_are_closed():
    apart, touching = two_balls(STEP, TURN), two_balls(0.0, TURN)

    for found in (apart, touching):
        assert_closed(found)
        assert volume(found) == pytest.approx(8.0 / 3.0 * np.pi, rel=0.02)
    assert euler_number(apart) == 4
    upper = apart.vertices[:, 2] > 0.0
    assert not np.any(upper[apart.faces].any(axis=1) & ~upper[apart.faces].all(axis=1))


def test_points_in_the_same_plane_tear_nothing():
    """Pairs of points that mirror each other are in a plane."""
    found = two_balls(STEP, np.diag([1.0, 1.0, -1.0]))

    assert_closed(found)
    assert euler_number(found) == 4


@pytest.mark.parametrize("seed", range(5))
def test_lines_of_sight_without_sense_give_a_manifold(seed):
    """Full parts touch at edges and points, where the surface has vertices of its own for each; it ends at the hull."""
    rng = np.random.default_rng(seed)
    points, at = rng.uniform(-1.0, 1.0, (400, 3)), rng.integers(0, 400, 2000)
    cloud = Cloud(points, points, np.zeros((400, 3), np.uint8), np.full(400, STEP))
    centers, weight = points[at] + rng.normal(0.0, 0.5, (2000, 3)), rng.uniform(1.0, 20.0, 2000).astype(np.float32)

    found, _ = cut_surface(cloud, Sights(at, centers, weight))

    assert_manifold(found)
    assert len(np.unique(found.vertices, axis=0)) < 0.95 * len(found.vertices)


@pytest.fixture
def scattered():
    """Points, unit normals, colors and steps from 0.05 to 0.4."""
    rng = np.random.default_rng(4)
    points, normals = rng.normal(size=(2, 3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points, normals, rng.integers(0, 256, (3000, 3)).astype(np.uint8), rng.uniform(0.05, 0.4, 3000)


def test_points_within_a_cube_become_their_mean():
    points = np.array([[0.1, 0.1, 0.1], [0.9, 0.1, 0.3], [1.1, 0.1, 0.1], [-0.1, 0.1, 0.1], [0.5, 0.5, 0.5]])
    normals = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0, 0, 1.0], [0, 0, 1.0]])
    colors = np.array([[0, 10, 250], [2, 20, 255], [7, 7, 7], [8, 8, 8], [9, 9, 9]], np.uint8)

    found = thin(points, normals, colors, np.array([1.0, 1.4, 0.8, 1.0, 1.5]))  # sides of 1, 1, 1, 1 and 2

    order = np.argsort(found.points[:, 0])
    np.testing.assert_allclose(
        found.points[order], [[-0.1, 0.1, 0.1], [0.5, 0.1, 0.2], [0.5, 0.5, 0.5], [1.1, 0.1, 0.1]]
    )
    np.testing.assert_allclose(found.normals[order][1], [0.5**0.5, 0.5**0.5, 0.0])
    np.testing.assert_array_equal(found.colors[order], [[8, 8, 8], [1, 15, 252], [9, 9, 9], [7, 7, 7]])
    np.testing.assert_allclose(found.step[order], [1.0, 1.2, 1.5, 0.8])


def test_thinning_does_not_depend_on_the_order(scattered):
    order = np.random.default_rng(0).permutation(3000)

    one, other = thin(*scattered), thin(*(values[order] for values in scattered))

    assert 500 < len(one.points) < 2900
    for name in ("points", "normals", "step"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(other.colors.astype(int), one.colors.astype(int), rtol=0.0, atol=1)


def test_thin_points_are_one_in_a_cube(scattered):
    points, normals, colors, _ = scattered

    found = thin(points, normals, colors, np.full(3000, 0.26))

    assert len(np.unique(np.floor(found.points / 0.25), axis=0)) == len(found.points)
    assert len(np.unique(np.floor(points / 0.25), axis=0)) == len(found.points)
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0)


def test_opposite_normals_cancel_without_an_error():
    found = thin(np.full((2, 3), 0.5), np.array([[0, 0, 1.0], [0, 0, -1.0]]), np.zeros((2, 3), np.uint8), np.ones(2))
    np.testing.assert_array_equal(found.normals, [[0.0, 0.0, 0.0]])


@pytest.mark.parametrize("most", [1, 2, 3, 20])
def test_lines_of_sight_are_few_and_even_among_the_photos(most):
    rng = np.random.default_rng(6)
    sees = rng.random((12, 300)) < rng.random(300)
    sees[:, 0] = False  # a point that no photo sees
    centers = rng.normal(size=(12, 3))

    found = choose_sights([np.flatnonzero(row) for row in sees], centers, 300, most)

    total = sees.sum(axis=0)
    used = np.minimum(total, most)
    np.testing.assert_array_equal(np.bincount(found.point, minlength=300), used)
    np.testing.assert_allclose(np.bincount(found.point, found.weight, 300), total, rtol=1e-6)
    photo = np.array([np.flatnonzero((centers == center).all(axis=1))[0] for center in found.center])
    assert sees[photo, found.point].all()
    # of the photos that see a point, each part of the same size has one
    rank = (np.cumsum(sees, axis=0) - 1)[photo, found.point]
    parts = rank * used[found.point] // total[found.point]
    assert len(np.unique(np.column_stack([found.point, parts]), axis=0)) == len(parts)
