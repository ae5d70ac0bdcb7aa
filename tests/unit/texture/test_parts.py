"""The steps of the texture one by one, each against a plain second way to the same answer."""

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from painted_box import around, box, sightings

from sfm_app.errors import ReconstructionError
from sfm_app.geometry.triangles import morton_order
from sfm_app.texture import PhotoView, photo_view
from sfm_app.texture.appearance import median, outlier_mask, photo_gains
from sfm_app.texture.charts import MARGIN, Charts, absorb_small_charts, folds, pack
from sfm_app.texture.facets import NONE, components, facets
from sfm_app.texture.pages import canvas, fill_background
from sfm_app.texture.seams import blend_weights, block_sizes, level_seams, solve_ties, square_texels, squares
from sfm_app.texture.sightings import sharpness, sharpness_factors
from sfm_app.texture.view_selection import PRICE_OF_DETAIL, choose_photos
from sfm_app.texture.views import project, sample
from sfm_app.types import CameraModel, Surface


def strip(squares_along=4):
    """A flat band of unit squares, two triangles each."""
    x = np.arange(squares_along + 1.0)
    vertices = np.concatenate([np.column_stack([x, 0 * x, 0 * x]), np.column_stack([x, 0 * x + 1, 0 * x])])
    k, n = np.arange(squares_along), squares_along + 1
    faces = np.concatenate([np.column_stack([k, k + 1, k + 1 + n]), np.column_stack([k, k + 1 + n, k + n])])
    return facets(Surface(vertices, faces.astype(np.int64), np.zeros((2 * n, 3), np.uint8)))


# views


def test_projection_is_opencvs():
    rng = np.random.default_rng(1)
    view = around(1)[0]
    lens = (500.0, 480.0, 160.0, 120.0, -0.1, 0.05, 0.002, -0.001)
    view = PhotoView("a", lens, view.cam_from_world, 320, 240)
    points = rng.uniform(-1, 1, (50, 3))
    K = np.array([[500.0, 0, 160], [0, 480, 120], [0, 0, 1]])
    rotation = cv2.Rodrigues(np.ascontiguousarray(view.cam_from_world[:, :3]))[0]
    shift = np.ascontiguousarray(view.cam_from_world[:, 3])
    expected = cv2.projectPoints(points, rotation, shift, K, np.array(lens[4:]))[0][:, 0]
    found = np.array([project(view.row, *point) for point in points])
    np.testing.assert_allclose(found[:, :2], expected, atol=1e-9)
    behind = view.center - 3 * view.cam_from_world[2, :3]
    assert project(view.row, *behind)[2] == 0.0


def test_a_scaled_view_sees_the_same_in_another_size():
    view = around(1)[0]
    half = view.with_size(160, 120)
    point = (0.3, 0.2, -0.1)
    np.testing.assert_allclose(np.array(project(half.row, *point)[:2]) * 2, project(view.row, *point)[:2])


def test_other_camera_models_are_refused():
    camera = CameraModel("FISHEYE", (1.0,) * 8, np.eye(3), 10, 10)
    with pytest.raises(ReconstructionError, match="FISHEYE"):
        photo_view("a", camera, np.eye(3, 4))


def test_sampling_is_linear_between_pixel_centers():
    y, x = np.mgrid[:5, :7]
    photo = np.stack([10 * x, 20 * y, x + y], axis=2).astype(np.uint8)
    assert sample(photo, 2.75, 3.25, 0) == pytest.approx(22.5)
    assert sample(photo, 2.75, 3.25, 1) == pytest.approx(55.0)
    assert sample(photo, -4.0, 99.0, 0) == 0.0


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=12))
@settings(deadline=None)
def test_median_is_numpys(values):
    assert median(np.array([*values, 7.0, -7.0]), len(values)) == pytest.approx(np.median(values))


# what photos show


def test_blur_lowers_sharpness():
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.integers(0, 255, (200, 300, 3), np.uint8), (0, 0), 0.8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.0)
    found = np.array([sharpness(noise), sharpness(noise[:, 50:]), sharpness(blurred)])
    factors = sharpness_factors(found)
    assert factors[2] < 0.5 * factors[0]
    assert factors[1] == pytest.approx(factors[0], rel=0.1)


@pytest.mark.parametrize("strays", [0.0, 0.2])
def test_gains_come_back_through_noise_and_strays(strays):
    rng = np.random.default_rng(3)
    truth = rng.uniform(0.6, 1.4, (6, 3))
    truth /= np.exp(np.log(truth).mean(axis=0))
    albedo = rng.uniform(40, 150, (3000, 3))
    colors = albedo * truth[:, None, :] * rng.normal(1.0, 0.03, (6, 3000, 3))
    wrong = rng.random((6, 3000)) < strays
    colors[wrong] = rng.uniform(0, 255, (wrong.sum(), 3))
    first = np.arange(3000) * 5 // 3000  # a chain: each triangle is seen by two photos next to each other
    seen = np.zeros((6, 3000), bool)
    seen[first, np.arange(3000)] = seen[first + 1, np.arange(3000)] = True
    found = photo_gains(sightings(seen, np.clip(colors, 0, 255).astype(np.uint8)))
    np.testing.assert_allclose(found, truth, rtol=0.08 if strays else 0.03)


def test_photos_that_share_nothing_keep_their_exposure():
    colors = np.full((3, 100, 3), 100, np.uint8)
    colors[2] = 200
    seen = np.zeros((3, 100), bool)
    seen[:2, :50] = seen[2, 50:] = True
    np.testing.assert_allclose(photo_gains(sightings(seen, colors)), 1.0)


def test_strangers_are_areas_not_specks():
    mesh = facets(box(16))
    rng = np.random.default_rng(5)
    count = len(mesh.faces)
    colors = (120 + rng.normal(0, 5, (4, count, 3))).astype(np.uint8)
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    person = np.linalg.norm(centers - [1.0, 0.1, 0.1], axis=1) < 0.35
    colors[2, person] = (20, 160, 220)
    speck = int(np.argmax(centers[:, 1]))
    colors[1, speck] = 200
    seen = np.ones((4, count), bool)
    found = outlier_mask(sightings(seen, colors), np.ones((4, 3)), mesh.neighbors).reshape(seen.shape)
    assert found[2, person].all()
    assert 0 < found[2].sum() - person.sum() < 0.6 * person.sum()  # a rim around it, no more
    assert not found[[0, 1, 3]].any()
    two = outlier_mask(sightings(seen[:2], colors[1:3]), np.ones((2, 3)), mesh.neighbors)
    assert not two.any()


# one photo for each triangle


def energy(chosen, worth, mesh):
    lost = np.log(worth.max(axis=0) / worth[chosen, np.arange(len(chosen))])
    size = np.sqrt(0.5 / (np.sqrt(3) / 4 * mesh.spacing**2))
    corners = mesh.vertices[mesh.faces]
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2) / mesh.spacing
    beside = mesh.neighbors
    cut = (beside != NONE) & (chosen[beside] != chosen[:, None])
    return PRICE_OF_DETAIL * size * np.minimum(lost, 3.0).sum() + (lengths * cut).sum() / 2


@pytest.mark.parametrize("seed", range(6))
def test_labels_are_the_cheapest_of_all(seed):
    mesh = strip(3)
    worth = np.exp(np.random.default_rng(seed).normal(0, 4, (3, 6))).astype(np.float32)
    least = min(energy(np.array(labels), worth, mesh) for labels in itertools.product(range(3), repeat=6))
    found = choose_photos(sightings(worth), mesh)
    assert energy(found, worth, mesh) == pytest.approx(least, abs=1e-4)


def test_photos_that_must_not_be_used_are_not():
    mesh = strip(4)
    worth = np.full((2, 8), 5.0, np.float32)
    worth[0, :3] = 0.0
    worth[1, :2] = -9.0
    found = choose_photos(sightings(worth), mesh)
    assert (found[:2] == NONE).all()
    assert found[2] == 1
    assert (found[3:] != NONE).all()


def test_specks_go_over_to_their_neighbors():
    mesh = facets(box(6))
    chosen = np.zeros(len(mesh.faces), np.int32)
    chosen[100], chosen[200] = 1, 1
    usable = np.ones((2, len(chosen)), bool)
    usable[0, 200] = False
    found = absorb_small_charts(chosen, sightings(usable), mesh.neighbors)
    assert np.flatnonzero(found).tolist() == [200]


# charts and pages


def test_components_hang_together():
    mesh = strip(4)
    group = np.array([0, 0, 1, 1, 0, 0, 1, NONE], np.int64)
    of, count = components(group, mesh.neighbors)
    assert count == 3
    assert of.tolist() == [0, 0, 1, 2, 0, 0, 1, NONE]


def test_a_fold_is_found_and_neighbors_are_not():
    corners = np.array([[[0, 0], [9, 0], [9, 9]], [[0, 0], [9, 9], [0, 9]], [[2, 1], [8, 1], [8, 7]]], float)
    assert folds(np.array([0, 0, 0], np.int32), 1, corners + 0.3).tolist() == [False, False, True]
    assert not folds(np.array([0, 0, 1], np.int32), 2, corners + 0.3).any()


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.sampled_from([256, 512]), st.integers(1, 3))
@settings(deadline=None, max_examples=25)
def test_packed_charts_keep_their_distance(seed, count, page_px, pages):
    rng = np.random.default_rng(seed)
    size = rng.uniform(1, 150, (count, 1, 1))
    corners = rng.uniform(0, 1, (count, 3, 2)) * size + rng.uniform(0, 900, (count, 1, 2))
    charts = Charts(np.arange(count, dtype=np.int32), np.zeros(count, np.int32), corners)
    blocks = np.array([[10, 6], [40, 2]], np.int32)
    layout, places = pack(charts, blocks, page_px, pages)
    assert all(max(width, height) <= page_px for width, height in layout.sizes)
    moved = corners * layout.scale + layout.shift[:, None, :]
    taken = [np.zeros((height, width), int) for width, height in layout.sizes]
    for chart in range(count):
        page = layout.page[chart]
        alone = canvas(layout.sizes[page], np.array([chart]), moved).owner != NONE
        low, high = moved[chart].min(axis=0), moved[chart].max(axis=0)
        assert (low >= MARGIN - 1e-9).all()
        assert (high <= np.array(layout.sizes[page]) - MARGIN + 1e-9).all()
        taken[page] += alone
    for (page, x, y), (width, height) in zip(places, blocks, strict=True):
        taken[page][y : y + height, x : x + width] += 1
    assert max(int(page.max()) for page in taken) == 1


def test_squares_show_three_colors_exactly():
    rng = np.random.default_rng(2)
    colors = rng.uniform(60, 190, (5, 3, 3))
    texels = square_texels(colors).astype(float)
    np.testing.assert_allclose(texels[:, 0, 0], colors[:, 0], atol=0.5)
    middle = texels[:, 0, 0] + (texels[:, 0, 1] - texels[:, 0, 0]) / 3 + (texels[:, 1, 0] - texels[:, 0, 0]) / 3
    np.testing.assert_allclose(middle, colors.mean(axis=1), atol=1.0)


def test_squares_never_share_a_texel():
    sizes = block_sizes(9000)
    places = np.array([[k, 0, 0] for k in range(len(sizes))], np.int32)
    found = squares(places, sizes, 9000)
    assert len(np.unique(found, axis=0)) == 9000
    for k, (width, height) in enumerate(sizes):
        here = found[found[:, 0] == k]
        assert (here[:, 1].max() + 2, here[:, 2].max() + 2) == (width, height)


def test_background_takes_the_color_next_to_it():
    page = np.zeros((64, 48, 3), np.uint8)
    painted = np.zeros((64, 48), bool)
    page[:20, :10], painted[:20, :10] = 200, True
    page[40:, 30:], painted[40:, 30:] = 60, True
    filled = fill_background(page.copy(), painted)
    np.testing.assert_array_equal(filled[painted], page[painted])
    assert (filled[19:22, 9:12] == 200).all()
    assert set(np.unique(filled)) >= {60, 200}
    assert filled.min() >= 60


# blending and leveling


def test_weights_blend_near_the_seam_only():
    mesh = strip(12)
    chosen = np.tile((np.arange(12) >= 6).astype(np.int32), 2)
    blend = blend_weights(chosen, sightings(np.ones((2, 24))), mesh)
    sums = np.bincount(blend.vertex, blend.weight)
    np.testing.assert_allclose(sums, 1.0, atol=1e-6)
    first = np.zeros(26)
    first[blend.vertex[blend.photo_rows(0)]] = blend.weight[blend.photo_rows(0)]
    assert first[6] == pytest.approx(0.5, abs=0.1)
    assert (first[:2] == 1.0).all()
    assert (first[11:13] == 0.0).all()
    assert (np.diff(first[:13]) <= 1e-9).all()


def test_leveling_takes_the_step_out_of_a_seam():
    mesh = strip(40)
    chosen = np.tile((np.arange(40) >= 20).astype(np.int32), 2)
    colors = np.empty((2, 80, 3), np.uint8)
    colors[0], colors[1] = 100, 120
    gains, seen = np.ones((2, 3)), sightings(np.ones((2, 80)), colors)
    blend = level_seams(blend_weights(chosen, seen, mesh), seen, gains, mesh)
    both = np.intersect1d(blend.vertex[blend.photo_rows(0)], blend.vertex[blend.photo_rows(1)])
    for vertex in both:
        one, other = (blend.offset[blend.photo_rows(p)][blend.vertex[blend.photo_rows(p)] == vertex] for p in (0, 1))
        np.testing.assert_allclose(100 + one, 120 + other, atol=1.5)
    assert len(both) > 4


def test_ties_are_solved_as_by_elimination():
    rng = np.random.default_rng(8)
    one, other = rng.integers(0, 30, (2, 90))
    one, other = one[one != other], other[one != other]
    weights = rng.uniform(0.5, 2.0, len(one))
    right = rng.normal(size=(30, 3))
    matrix = 0.5 * np.eye(30)
    for i, j, w in zip(one, other, weights, strict=True):
        matrix[[i, j], [i, j]] += w
        matrix[i, j] -= w
        matrix[j, i] -= w
    found = solve_ties(one, other, weights, 0.5, right)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), atol=0.02)


def test_points_near_each_other_come_after_each_other():
    points = np.random.default_rng(4).uniform(-3, 5, (2000, 3))
    steps = np.linalg.norm(np.diff(points[morton_order(points)], axis=0), axis=1)
    assert np.median(steps) < 0.15 * np.median(np.linalg.norm(np.diff(points, axis=0), axis=1))
    assert len(morton_order(np.empty((0, 3)))) == 0


@pytest.mark.parametrize("k1", [-0.2, 0.0, 0.1])
def test_the_widest_angle_bounds_what_a_photo_shows(k1):
    view = around(1, k1=k1)[0]
    rays = np.random.default_rng(0).normal(size=(4000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    inside = [
        angle
        for ray, angle in zip(rays, np.arccos(rays @ view.axis), strict=True)
        for u, v, depth in [project(view.row, *(view.center + ray))]
        if depth > 0 and 0 <= u <= view.width and 0 <= v <= view.height
    ]
    assert max(inside) <= view.widest_angle < max(inside) + np.radians(8)


def test_views_are_found_by_photo_and_triangle():
    worth = np.array([[0, 2, 0, 5.0], [1, 0, 0, -3], [0, 0, 0, 0]])
    seen = sightings(worth)
    photo, face = (part.ravel() for part in np.indices(worth.shape))

    rows = seen.find(photo, face)
    np.testing.assert_array_equal(rows != NONE, worth.ravel() != 0)
    np.testing.assert_array_equal(seen.worth[rows[rows != NONE]], worth.ravel()[rows != NONE])
    np.testing.assert_array_equal(seen.is_usable(photo, face), worth.ravel() > 0)
    assert seen.find(0, np.array([NONE, 3])).tolist() == [NONE, 1]
    part = seen.select_triangles(np.array([False, True, False, True]))
    assert (part.photos, part.triangles, part.face.tolist()) == (3, 2, [0, 1, 1])
    assert part.face_rows.tolist() == [0, 1, 2]
