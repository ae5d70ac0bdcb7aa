"""Wide lenses from matches alone, with a deviation that covers the truth."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import sfm_app
from sfm_app.camera.projection import Fisheye
from sfm_app.geometry.epipolar import signed_distances, squared_distances
from sfm_app.selfcal.wide_lens import bearings_through, find_lens, redundancy, search_rays, shows_panoramas

THETA = np.linspace(0.0, 1.4, 8)


@pytest.mark.parametrize(
    ("exponent", "radius"),
    [
        (1.0, np.tan(THETA)),
        (0.5, 2 * np.tan(THETA / 2)),
        (0.0, THETA),
        (-0.5, 2 * np.sin(THETA / 2)),
        (-1.0, np.sin(THETA)),
    ],
)
def test_exponents_are_the_known_projections(exponent, radius):
    np.testing.assert_allclose(Fisheye(300.0, exponent).radius(THETA), 300.0 * radius)


@given(exponent=st.floats(-0.9, 1.0), theta=st.floats(0.0, 1.5), azimuth=st.floats(-3.0, 3.0))
def test_a_ray_comes_back(exponent, theta, azimuth):
    lens = Fisheye(0.4, exponent, (0.02, -0.01))
    ray = np.array([[np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)]])
    np.testing.assert_allclose(lens.rays(lens.project(ray)), ray, atol=1e-9)


def test_exponents_near_zero_are_no_step():
    radii = [Fisheye(1.0, e).radius(THETA) for e in (-1e-5, 0.0, 1e-5)]
    np.testing.assert_allclose(radii[0], radii[1], atol=1e-9)
    np.testing.assert_allclose(radii[2], radii[1], atol=1e-9)


def test_the_field_of_view_counts_both_sides():
    assert Fisheye(100.0, 0.0).field_deg(200.0 * np.pi / 2) == pytest.approx(180.0)
    assert Fisheye(100.0, 1.0).field_deg(200.0) == pytest.approx(90.0)


@pytest.mark.parametrize("exponent", [1.0, 0.3, 0.0, -0.5])
def test_slopes_are_those_of_the_rays(exponent):
    lens, points = Fisheye(0.45, exponent), np.array([[0.0, 0.0], [0.2, -0.1], [-0.4, 0.3]])
    rays, by_x, by_y = np.hsplit(bearings_through(lens, np.tile(points, 2))[:, 9:], 3)
    for slope, step in ((by_x, [1e-4, 0.0]), (by_y, [0.0, 1e-4])):
        np.testing.assert_allclose(rays + slope * 1e-4, lens.rays(points + step), atol=3e-7)
        np.testing.assert_allclose(np.einsum("ni,ni->n", rays, slope), 0.0, atol=1e-4)


slow = pytest.mark.slow
SIZE = (960, 640)
CENTER = (491.0, 313.0)


def look(lens, X, R, C, noise):
    """Where points are seen from a place, and which of them a photo shows."""
    rays = (X - C) @ R.T
    x = lens.project(rays) + noise
    deep = np.linalg.norm(rays, axis=1) > 0.3
    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    limit = lens.angle(np.array([0.5 * np.hypot(*SIZE)]))[0]
    return x, deep & (theta < limit) & (x > 0).all(axis=1) & (x < SIZE).all(axis=1)


def photos_through(lens, seed=0, *, photos=6, points=700, noise_px=0.5, wrong=0.3):
    """Raw matches of all pairs of photos taken inside a cloud of points, some of them wrong."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(points, 3)) * [4.0, 2.0, 3.0] + [0.0, 0.0, 3.0]
    seen = []
    for k in range(photos):
        R = Rotation.from_euler("xyz", rng.normal(0.0, 0.25, 3)).as_matrix()
        C = np.array([1.2 * (k - photos / 2) / photos, rng.normal(0.0, 0.3), rng.normal(0.0, 0.4)]) * 1.5
        seen.append(look(lens, X, R, C, rng.normal(0.0, noise_px, (points, 2))))
    found = []
    for (x1, ok1), (x2, ok2) in combinations(seen, 2):
        both = np.flatnonzero(ok1 & ok2)
        matches = np.hstack([x1[both], x2[both]])
        bad = rng.random(len(both)) < wrong
        matches[bad, 2:] = rng.uniform(0, SIZE, (int(bad.sum()), 2))
        found.append(matches)
    return found


def lens_of(field_deg, exponent):
    return Fisheye(480.0 / float(Fisheye(1.0, exponent).radius(np.radians(field_deg / 2))), exponent, CENTER)


@slow
@pytest.mark.parametrize(("field_deg", "exponent"), [(120.0, -0.5), (150.0, 0.5), (175.0, 0.0)])
def test_the_lens_is_found(field_deg, exponent):
    true = lens_of(field_deg, exponent)
    found = find_lens(photos_through(true), SIZE)
    assert found is not None and found.is_fisheye
    theta = np.linspace(0.05, np.radians(field_deg / 2), 30)
    errors = np.abs(found.lens.radius(theta) - true.radius(theta))
    assert errors.max() / SIZE[0] < 0.003
    assert 0 < (errors / found.radius_deviation_px(theta)).max() < 4
    deviations = np.sqrt(np.diag(np.array(found.covariance))[2:])
    assert np.all(np.abs(np.array(found.lens.center) - CENTER) < 4 * deviations)
    assert np.all(deviations < 15)
    assert found.lens.field_deg(SIZE[0]) == pytest.approx(field_deg, abs=1.0)


@slow
def test_a_perspective_lens_is_none():
    found = find_lens(photos_through(Fisheye(800.0, 1.0, CENTER)), SIZE)
    assert found is not None and not found.is_fisheye
    assert found.perspective_support > found.support - 0.01


class Barrel(Fisheye):
    """A perspective lens with k1 = -0.22."""

    def project(self, rays):
        plane = rays[:, :2] / np.where(rays[:, 2:] > 0.3, rays[:, 2:], 0.3)
        return self.focal * plane * (1.0 - 0.22 * np.sum(plane**2, axis=1, keepdims=True)) + self.center

    def angle(self, radius):
        return np.full(np.shape(radius), 0.9)


def facade_through(lens, seed, *, photos=4, points=600, noise_px=0.1):
    """Matches of all pairs of photos along a facade; half of those of the last pair are of the next window."""
    rng = np.random.default_rng(seed)
    X = np.column_stack([*rng.uniform(-1.0, 1.0, (2, points)) * [[6.0], [3.0]], rng.normal(5.0, 0.02, points)])
    turns = [Rotation.from_euler("xyz", rng.normal(0.0, 0.15, 3)).as_matrix() for _ in range(photos)]
    places = [[0.9 * k, *rng.normal(0.0, [0.9, 1.2])] for k in range(-photos // 2, photos // 2)]
    noise, window = rng.normal(0.0, noise_px, (photos, points, 2)), np.array([-0.6, 0.15, 0.0])
    found = []
    for a, b in combinations(range(photos), 2):
        next_one = (rng.random((points, 1)) < 0.5) & ((a, b) == (photos - 2, photos - 1))
        x1, shown = look(lens, X, turns[a], places[a], noise[a])
        x2, also = look(lens, X + next_one * window, turns[b], places[b], noise[b])
        found.append(np.hstack([x1, x2])[shown & also])
    return found


@slow
@pytest.mark.parametrize("facade", [None, 2, 8])
def test_a_barrel_lens_is_no_fisheye_even_where_a_pair_shows_repeated_things(facade):
    """On facade 2 one pair favors a fisheye by more than all others do a barrel; on 8 a narrow rival gets stuck."""
    if facade is None:
        matches = photos_through(Barrel(870.0, 1.0, CENTER), wrong=0.1)
    else:
        matches = facade_through(Barrel(700.0, 1.0, CENTER), facade)
    found = find_lens(matches, SIZE)
    assert found is not None and found.support - found.perspective_support > 0.05
    assert found.log_odds < 0.0 and not found.is_fisheye


@slow
def test_the_same_seed_gives_the_same_lens():
    matches = photos_through(lens_of(120.0, 0.0), photos=3)
    assert find_lens(matches, SIZE, 0) == find_lens(matches, SIZE, 0) is not None


@slow
@pytest.mark.parametrize("matches", [[], [np.zeros((3, 4))], [np.full((200, 4), 300.0)] * 2])
def test_too_few_pairs_give_no_lens(matches):
    assert find_lens(matches, SIZE) is None


@slow
@pytest.mark.parametrize("kind", ["noise", "one point", "same photo"])
def test_hostile_matches_give_an_answer_or_none(kind):
    rng = np.random.default_rng(0)
    x = rng.uniform(0, SIZE[1], (5, 300, 2))
    given = {
        "noise": [np.hstack([a, rng.uniform(0, SIZE[1], (300, 2))]) for a in x],
        "one point": [np.full((300, 4), 200.0)] * 5,
        "same photo": [np.hstack([a, a]) for a in x],
    }
    found = find_lens(given[kind], SIZE)
    assert found is None or np.isfinite(found.lens.focal)


@slow
def test_the_two_distances_agree():
    lens = lens_of(150.0, 0.0)
    matches = photos_through(lens, noise_px=0.0, wrong=0.0)[0]
    pair = bearings_through(lens, matches)
    support, F = search_rays(pair, np.random.default_rng(0).integers(0, len(matches), (50, 8)), 2.0)
    assert support == pytest.approx(len(matches), rel=0.02)
    signed = signed_distances(F, pair)
    np.testing.assert_allclose(signed**2, squared_distances(F[None], pair)[0], atol=1e-12)
    assert np.median(np.abs(signed)) < 1e-3


@slow
@pytest.mark.parametrize("matches", [[np.zeros((5, 3))], [np.full((5, 4), np.nan)]])
def test_bad_input_is_refused(matches):
    with pytest.raises(ValueError, match="finite arrays of shape"):
        sfm_app.estimate_lens(matches, SIZE)


@slow
def test_keypoints_in_many_photos_are_worth_less_than_their_matches():
    photos = np.random.default_rng(0).uniform(0, 1, (6, 40, 2))
    alone = [np.hstack([photos[0], photos[1]])]
    everywhere = [np.hstack([a, b]) for a, b in combinations(photos, 2)]
    assert redundancy(alone) == 1.0
    assert redundancy(everywhere) == pytest.approx(15 / 9)


def panoramas_of(points=600, photos=5, wrong=0.3):
    """Raw matches of all pairs of panoramas of 800 x 400 px in the middle of a cloud of points."""
    rng, size = np.random.default_rng(2), np.array([800.0, 400.0])
    X, seen = rng.normal(size=(points, 3)) * 4.0, []
    for _ in range(photos):
        turned = (X - rng.normal(0.0, 0.8, 3)) @ Rotation.from_euler("y", rng.uniform(0.0, 6.0)).as_matrix()
        longitude, latitude = np.arctan2(*turned[:, [0, 2]].T), np.arctan2(turned[:, 1], np.hypot(*turned[:, [0, 2]].T))
        x = (np.column_stack([longitude / (2.0 * np.pi), latitude / np.pi]) + 0.5) * size
        seen.append(x + rng.normal(0.0, 0.3, x.shape))
    pairs = [np.hstack(pair) for pair in combinations(seen, 2)]
    for pair in pairs:
        bad = rng.random(points) < wrong
        pair[bad, 2:] = rng.uniform(0.0, size, (int(bad.sum()), 2))
    return pairs


@slow
def test_matches_distinguish_panoramas_from_photos():
    photos = photos_through(lens_of(120.0, 0.0))
    assert shows_panoramas(panoramas_of(), (800, 400))
    assert not shows_panoramas(panoramas_of(), (800, 401))
    assert not shows_panoramas(photos, SIZE)
    assert not shows_panoramas([pair / [1.2, 1.6, 1.2, 1.6] for pair in photos], (800, 400))
    assert not shows_panoramas([], (800, 400))
