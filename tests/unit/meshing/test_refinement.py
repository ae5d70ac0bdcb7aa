"""A surface that is off by some pixels comes to lie where the photos say."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from sfm_app.geometry.raster import Raster
from sfm_app.geometry.triangles import areas, unique_edges, vertex_normals
from sfm_app.meshing.agreement import Sight, compare
from sfm_app.meshing.refinement import Sights, finest_pixels, look, refine, split_long_edges
from sfm_app.synthetic.shapes import ball
from sfm_app.types import Surface
from tests.unit.meshing.relief import PIXEL, SIDE, gray_at, grid, relief

BUMP_PX, WIDTH_PX = 3.0, 12.0


def flat(x, y):
    return 0.0 * x


def bumps(x, y):
    """Waves of 3 pixels, 24 pixels apart."""
    return 0.5 * BUMP_PX * PIXEL * np.sin(np.pi * x / (WIDTH_PX * PIXEL)) * np.cos(np.pi * y / (WIDTH_PX * PIXEL))


def inner_errors(surface, height, half=0.2):
    x, y, z = surface.vertices.T
    inside = (np.abs(x) < half) & (np.abs(y) < half)
    return (z - height(x, y))[inside]


@pytest.mark.parametrize("off_px", [-0.8, 0.8])
def test_a_pair_pulls_a_plane_back_to_where_it_is(off_px):
    scene = relief(flat)
    surface = grid(lambda x, y: 0.0 * (x + y) + off_px * PIXEL)
    vertices, faces = surface.vertices, surface.faces
    sights = [look(surface, photo, 1.0) for photo in scene.photos[:2]]
    normals = np.tile(np.float32([0, 0, 1]), (len(faces), 1))

    pull = compare(vertices, faces, normals, sights[0], sights[1:])

    assert pull.g.sum() / pull.h.sum() == pytest.approx(-off_px * PIXEL, rel=0.2)
    assert 0.4 < pull.correlation / pull.pixels < 0.999


def test_bumps_of_some_pixels_come_back():
    scene = relief(bumps)
    start = grid(flat)
    before = inner_errors(start, bumps)

    found = refine(start, scene.photos, scene.partners, 100_000)

    after = inner_errors(found.surface, bumps)
    assert before.std() > 0.6 * PIXEL
    assert after.std() < 0.25 * before.std() and abs(after.mean()) < 0.15 * PIXEL
    assert found.correlations[-1] > found.correlations[0] + 0.01 and found.correlations[-1] > 0.98


def test_a_correct_surface_stays():
    scene = relief(bumps)
    found = refine(grid(bumps), scene.photos, scene.partners, 100_000)

    assert np.abs(inner_errors(found.surface, bumps)).mean() < 0.12 * PIXEL


def test_exposure_does_not_matter():
    scene = relief(bumps)
    darker = replace(scene.photos[1], gray=(0.6 * scene.photos[1].gray + 10).astype(np.uint8))
    found = refine(grid(flat), [scene.photos[0], darker, scene.photos[2]], scene.partners, 100_000)

    assert inner_errors(found.surface, bumps).std() < 0.3 * inner_errors(grid(flat), bumps).std()


def test_what_is_masked_says_nothing():
    scene = relief(bumps)
    masked = np.zeros((SIDE, SIDE), np.bool_)
    masked[:, : SIDE // 2] = True
    spoilt = [
        replace(photo, gray=np.where(masked, photo.gray[::-1], photo.gray), masked=masked) for photo in scene.photos
    ]
    found = refine(grid(flat), spoilt, scene.partners, 100_000).surface

    x, y, z = found.vertices.T
    left, right = (x < -0.15) & (np.abs(y) < 0.2), (x > 0.15) & (x < 0.25) & (np.abs(y) < 0.2)
    assert np.abs(z[left]).max() < 0.3 * PIXEL, "nothing pulls there"
    assert (z - bumps(x, y))[right].std() < 0.4 * bumps(x, y)[right].std()


def test_an_object_with_an_inexact_outline_does_not_draw_what_lies_behind():
    """A textured bar before a plain wall; the surface has the wall, and the bar a pixel too narrow on each side."""
    height, half = 0.3, 0.1
    scene, photos = relief(flat), []
    for photo in scene.photos:
        posed = photo.posed
        v, u = np.indices(photo.gray.shape) + 0.5
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(posed.projection[:, :3]).T
        place = posed.center + rays * ((height - posed.center[2]) / rays[..., 2:])
        gray = np.where(np.abs(place[..., 0]) < half, 0.5 * gray_at(place[..., 0], place[..., 1]), 150)
        photos.append(replace(photo, gray=gray.clip(0, 255).astype(np.uint8)))
    wall, bar = grid(flat), grid(lambda x, y: 0.0 * (x + y) + height, half - PIXEL)
    count = len(wall.vertices)
    both = Surface(
        np.concatenate([wall.vertices, bar.vertices * [1.0, 4.0, 1.0]]),
        np.concatenate([wall.faces, bar.faces + count]), np.concatenate([wall.colors, bar.colors]),
    )  # fmt: skip

    found = refine(both, photos, scene.partners, 1).surface  # no triangle is divided

    at_wall = found.vertices[:, 2] < 0.5 * height
    assert np.count_nonzero(at_wall) == count
    assert np.abs(found.vertices[at_wall, 2]).max() < 0.2 * PIXEL
    assert np.abs(found.vertices[~at_wall, 2] - height).mean() < 0.5 * PIXEL


def test_photos_without_texture_change_nothing_but_roughness():
    scene = relief(flat)
    rng = np.random.default_rng(0)
    plain = [
        replace(photo, gray=np.clip(120 + rng.normal(0, 1.5, photo.gray.shape), 0, 255).astype(np.uint8))
        for photo in scene.photos
    ]
    found = refine(grid(flat), plain, scene.partners, 100_000)

    assert np.abs(inner_errors(found.surface, flat)).max() < 0.5 * PIXEL


def test_the_result_does_not_depend_on_threads():
    scene = relief(bumps)
    alone = refine(grid(flat), scene.photos, scene.partners, 100_000)
    with ThreadPoolExecutor(3) as pool:
        together = refine(grid(flat), scene.photos, scene.partners, 100_000, spread=pool.map)

    assert np.array_equal(alone.surface.vertices, together.surface.vertices)
    assert alone.correlations == together.correlations


def test_coarse_triangles_are_divided_no_further_than_allowed():
    scene = relief(flat)
    coarse = grid(flat, step=10 * PIXEL)

    fine = refine(coarse, scene.photos, scene.partners, 100_000).surface
    few = refine(coarse, scene.photos, scene.partners, 3 * len(coarse.faces)).surface

    assert len(fine.faces) > 3 * len(coarse.faces) and len(few.faces) <= 3 * len(coarse.faces)


def test_a_pixel_is_as_large_as_the_distance_makes_it():
    scene = relief(flat)
    points = np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]])

    near, nowhere = finest_pixels(points, [photo.posed for photo in scene.photos])

    assert near == pytest.approx(1.9 / 320.0, rel=0.05) and np.isinf(nowhere)
    halves = [photo.posed_at(0.5) for photo in scene.photos]
    half = halves[0]
    assert finest_pixels(points, halves)[0] == pytest.approx(2 * near, rel=0.02)
    assert (half.width, half.height) == (SIDE // 2, SIDE // 2)


def drawn(made, seconds=0.0, most_px=10_000):
    def look(number):
        time.sleep(seconds)
        made.append(number)
        return Sight(None, None, Raster(np.full((10, 10), number, np.float32), np.zeros((10, 10), np.int32)))

    return Sights(look, most_px)


def test_many_threads_that_ask_at_once_get_the_same_photo():
    made = []
    kept = drawn(made, seconds=0.05)
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda _: kept[3], range(8)))

    assert made == [3] and all(one is found[0] for one in found)


def test_the_photo_that_was_not_used_longest_is_dropped():
    made = []
    kept = drawn(made, most_px=200)
    for number in (0, 1, 0, 2, 0, 1):
        assert kept[number].raster.depth[0, 0] == number

    assert made == [0, 1, 2, 1]


def test_a_failure_is_raised_again():
    def fail(number):
        raise ValueError(f"photo {number}")

    kept = Sights(fail)
    for _ in range(2):
        with pytest.raises(ValueError, match="photo 5"):
            kept[5]


def closed_ball():
    """A sphere whose vertices are joined, with uneven triangles."""
    shape = ball(1.0, segments=14)
    _, first, one = np.unique(shape.vertices.round(6), axis=0, return_index=True, return_inverse=True)
    faces = one.ravel()[shape.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    colors = np.random.default_rng(0).integers(0, 256, (len(first), 3)).astype(np.uint8)
    return Surface(shape.vertices[first], faces, colors)


@pytest.mark.parametrize("longest", [0.3, 0.1])
def test_edges_are_halved_and_the_surface_stays_what_it_is(longest):
    before = closed_ball()
    after = split_long_edges(before, np.full(len(before.vertices), longest))

    assert areas(after.vertices, after.faces).sum() == pytest.approx(areas(before.vertices, before.faces).sum())
    edges, edge_of = unique_edges(after.faces)
    assert (np.bincount(edge_of.ravel()) == 2).all(), "it stays closed"
    directed = np.concatenate([after.faces[:, [0, 1]], after.faces[:, [1, 2]], after.faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed), "all triangles are turned the same way"
    assert (vertex_normals(after.vertices, after.faces) * after.vertices).sum(axis=1).min() > 0.5
    assert np.array_equal(after.vertices[: len(before.vertices)], before.vertices)
    assert len(after.faces) > len(before.faces) and len(edges) == 3 * len(after.faces) // 2


def test_only_where_it_is_asked_for():
    before = closed_ball()
    after = split_long_edges(before, np.where(before.vertices[:, 1] > 0, 0.1, np.inf))

    assert after.vertices[len(before.vertices) :, 1].min() > -1e-9


def test_a_new_vertex_has_the_mean_color():
    corners = np.array([[0.0, 0, 0], [4.0, 0, 0], [0.0, 1, 0]])
    flat = Surface(corners, np.array([[0, 1, 2]]), np.array([[0, 0, 0], [200, 100, 255], [0, 0, 0]], np.uint8))
    after = split_long_edges(flat, np.full(3, 4.05))

    assert len(after.faces) == 2 and after.colors[3].tolist() == [100, 50, 127]
    assert after.vertices[3].tolist() == [2.0, 0.5, 0.0]
