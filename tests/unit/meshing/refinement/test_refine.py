"""A surface that is off by some pixels comes to lie where the photos say."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from sfm_app.meshing.agreement import compare
from sfm_app.meshing.refinement import finest_pixels, look, refine
from tests.unit.meshing.refinement.conftest import PIXEL, SIDE, grid

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
def test_a_pair_pulls_a_plane_back_to_where_it_is(relief, off_px):
    scene = relief(flat)
    surface = grid(lambda x, y: 0.0 * (x + y) + off_px * PIXEL)
    vertices, faces = surface.vertices, surface.faces
    sights = [look(surface, photo, 1.0) for photo in scene.photos[:2]]
    normals = np.tile(np.float32([0, 0, 1]), (len(faces), 1))

    pull = compare(vertices, faces, normals, sights[0], sights[1:])

    assert pull.g.sum() / pull.h.sum() == pytest.approx(-off_px * PIXEL, rel=0.2)
    assert 0.4 < pull.correlation / pull.pixels < 0.999


def test_bumps_of_some_pixels_come_back(relief):
    scene = relief(bumps)
    start = grid(flat)
    before = inner_errors(start, bumps)

    found = refine(start, scene.photos, scene.partners, 100_000)

    after = inner_errors(found.surface, bumps)
    assert before.std() > 0.6 * PIXEL
    assert after.std() < 0.25 * before.std() and abs(after.mean()) < 0.15 * PIXEL
    assert found.correlations[-1] > found.correlations[0] + 0.01 and found.correlations[-1] > 0.98


def test_what_is_right_stays(relief):
    scene = relief(bumps)
    found = refine(grid(bumps), scene.photos, scene.partners, 100_000)

    assert np.abs(inner_errors(found.surface, bumps)).mean() < 0.12 * PIXEL


def test_exposure_does_not_matter(relief):
    scene = relief(bumps)
    darker = replace(scene.photos[1], gray=(0.6 * scene.photos[1].gray + 10).astype(np.uint8))
    found = refine(grid(flat), [scene.photos[0], darker, scene.photos[2]], scene.partners, 100_000)

    assert inner_errors(found.surface, bumps).std() < 0.3 * inner_errors(grid(flat), bumps).std()


def test_what_is_masked_says_nothing(relief):
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


def test_photos_without_texture_change_nothing_but_roughness(relief):
    scene = relief(flat)
    rng = np.random.default_rng(0)
    plain = [
        replace(photo, gray=np.clip(120 + rng.normal(0, 1.5, photo.gray.shape), 0, 255).astype(np.uint8))
        for photo in scene.photos
    ]
    found = refine(grid(flat), plain, scene.partners, 100_000)

    assert np.abs(inner_errors(found.surface, flat)).max() < 0.5 * PIXEL


def test_the_result_does_not_depend_on_threads(relief):
    scene = relief(bumps)
    alone = refine(grid(flat), scene.photos, scene.partners, 100_000)
    with ThreadPoolExecutor(3) as pool:
        together = refine(grid(flat), scene.photos, scene.partners, 100_000, spread=pool.map)

    assert np.array_equal(alone.surface.vertices, together.surface.vertices)
    assert alone.correlations == together.correlations


def test_coarse_triangles_are_divided_no_further_than_allowed(relief):
    scene = relief(flat)
    coarse = grid(flat, step=10 * PIXEL)

    fine = refine(coarse, scene.photos, scene.partners, 100_000).surface
    few = refine(coarse, scene.photos, scene.partners, 3 * len(coarse.faces)).surface

    assert len(fine.faces) > 3 * len(coarse.faces) and len(few.faces) <= 3 * len(coarse.faces)


def test_a_pixel_is_as_large_as_the_distance_makes_it(relief):
    scene = relief(flat)
    points = np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]])

    near, nowhere = finest_pixels(points, scene.photos, 1.0)

    assert near == pytest.approx(1.9 / 320.0, rel=0.05) and np.isinf(nowhere)
    assert finest_pixels(points, scene.photos, 0.5)[0] == pytest.approx(2 * near, rel=0.02)
    assert scene.photos[0].size_at(0.5) == (SIDE // 2, SIDE // 2)
