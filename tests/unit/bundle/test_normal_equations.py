"""Normal equations: of bundles that determine everything, and of others; elimination of points; widths."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.bundle.normal_equations import (
    Bundle,
    cost,
    elimination_width,
    linearize,
    lost_points,
    project,
    reduce,
    usable_mask,
    weigh,
)
from sfm_app.camera.rows import PERSPECTIVE

CAMERA = np.array([[900.0, 900.0, 500.0, 400.0, *[0.0] * 8]])
FAMILY = np.array([PERSPECTIVE])
SCALE_PX = 0.5


def rotations(count, step=0.15):
    angles = step * (np.arange(count) - (count - 1) / 2)
    c, s, o, i = np.cos(angles), np.sin(angles), np.zeros(count), np.ones(count)
    return np.moveaxis(np.array([[c, o, s], [o, i, o], [-s, o, c]]), 2, 0)


def bundle_of(X, R, centers, noise_px=0.3, seed=0):
    """Every photo sees every point; as measured through the camera with noise."""
    t = -np.einsum("nij,nj->ni", R, centers)
    photo, point = (index.ravel() for index in np.indices((len(R), len(X))))
    empty = Bundle(CAMERA, np.zeros(len(R), np.int64), R, t, X, photo, point, np.zeros((len(photo), 2)), FAMILY)
    with np.errstate(all="ignore"):
        seen = project(empty)[0]
    x = np.where(np.isfinite(seen), seen, 500.0) + np.random.default_rng(seed).normal(0, noise_px, (len(photo), 2))
    return Bundle(CAMERA, empty.camera, R, t, X, photo, point, x, FAMILY)


def box(count=60, depth=5.0, seed=1):
    return np.random.default_rng(seed).uniform([-1, -1, depth - 1], [1, 1, depth + 1], (count, 3))


def ring(count):
    R = rotations(count)
    return R, -5.0 * R[:, 2] + [0, 0, 5.0]


def walk(count):
    return np.tile(np.eye(3), (count, 1, 1)), np.column_stack([0.3 * np.arange(count), np.zeros((count, 2))])


SCENES = {
    "one point at infinity": lambda: bundle_of(np.vstack([box(), [[1e12, 0, 1e13]]]), *ring(6)),
    "half of them at infinity": lambda: bundle_of(np.vstack([box(), 1e12 * box()]), *walk(6)),
    "all at infinity": lambda: bundle_of(1e13 * box(), *walk(6)),
    "all photos from one place": lambda: bundle_of(box(), rotations(6), np.zeros((6, 3))),
    "one photo twice": lambda: bundle_of(box(), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))),
    "two photos": lambda: bundle_of(box(), *ring(2)),
    "three points": lambda: bundle_of(box(3), *ring(4)),
    "all points in one place": lambda: bundle_of(np.tile(box(1), (40, 1)), *ring(6)),
    "points on a line of sight": lambda: bundle_of(np.outer(np.arange(1, 30), [0, 0, 1.0]), *walk(4)),
    "a point in a camera": lambda: bundle_of(np.vstack([box(), ring(6)[1][:1]]), *ring(6)),
    "a point just before a camera": lambda: bundle_of(np.vstack([box(), [[0, 0, 1e-160]]]), *walk(4)),
    "a point behind": lambda: bundle_of(np.vstack([box(), [[0, 0, -3.0]]]), *walk(4)),
    "a point that is nowhere": lambda: bundle_of(np.vstack([box(), [[np.inf, 0, 1.0]], [[np.nan] * 3]]), *ring(6)),
    "all behind": lambda: bundle_of(box() - [0, 0, 20], *walk(4)),
    "no points": lambda: bundle_of(np.zeros((0, 3)), *ring(4)),
    "one photo": lambda: bundle_of(box(), *ring(1)),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scene", SCENES)
def test_whatever_is_seen_the_answer_is_numbers(scene):
    bundle = SCENES[scene]()
    found = reduce(bundle, SCALE_PX)
    for numbers in (found.H, found.g, found.pose_step, found.pose_response, found.point_step):
        assert np.isfinite(numbers).all()
    assert all(np.isfinite(steps).all() for steps in found.back_substitute(np.ones_like(CAMERA)))
    assert 0 < found.noise_px < 1 and np.linalg.eigvalsh(found.H).min() >= -1e-9 * np.abs(found.H).max()
    assert np.isfinite(cost(bundle, SCALE_PX))


def test_a_point_at_infinity_still_says_how_the_cameras_are_turned_and_keeps_its_depth():
    far = np.vstack([box(), [[1e11, 0, 1e12]]])
    near, both = reduce(bundle_of(box(), *ring(6)), SCALE_PX), reduce(bundle_of(far, *walk(6)), SCALE_PX)
    assert (near.open_points, near.observed.used) == (0, 360) and (both.open_points, both.observed.used) == (1, 366)
    ray = far[-1] / np.linalg.norm(far[-1])
    assert abs(both.point_step[-3:] @ ray) < 1e-3 * np.linalg.norm(far[-1])


def test_points_of_which_nothing_is_open_count_as_before():
    bundle = bundle_of(box(), *ring(6))
    more = bundle_of(np.vstack([box(), [[0, 0, -50.0]]]), *ring(6))
    found, other = reduce(bundle, SCALE_PX), reduce(more, SCALE_PX)
    assert (other.observed.used, other.open_points) == (360, 1), "behind all six photos, it says nothing"
    # noise differs, as observations come in another order
    assert np.diag(other.H) == pytest.approx(np.diag(found.H), rel=0.1)
    assert np.array_equal(other.point_step[-3:], np.zeros(3))


def test_noise_is_the_usual_one_where_nothing_is_left_over_and_the_measured_one_elsewhere():
    few, many = reduce(bundle_of(box(8), *ring(2)), SCALE_PX), reduce(bundle_of(box(200), *ring(6)), SCALE_PX)
    perfect = reduce(bundle_of(box(8), *ring(2), noise_px=0.0), SCALE_PX)
    assert 0.1 < few.noise_px < 0.5 and perfect.noise_px == pytest.approx(0.25)
    assert many.noise_px == pytest.approx(0.27, abs=0.05)


def test_what_cannot_be_seen_costs_more_than_what_is_off():
    bundle = bundle_of(np.vstack([box(), [[0, 0, -3.0]]]), *walk(4))
    off = bundle_of(box(), *walk(4))
    off.x[:4] += 500.0
    assert lost_points(bundle).nonzero()[0].tolist() == [60] and not lost_points(off).any()
    assert np.count_nonzero(~usable_mask(bundle, np.zeros_like(bundle.x))) == 4
    assert cost(bundle, SCALE_PX) > 1.1 * cost(off, SCALE_PX)


PHOTOS, CAMERAS, POINTS, SEEN = 5, 3, 20, 60
UNKNOWNS = 6 * PHOTOS + 12 * CAMERAS


@pytest.fixture
def measured():
    """Observations in any order, some points twice in a photo or never, photos of several cameras, one of none."""
    rng = np.random.default_rng(0)
    photo, point = rng.integers(0, PHOTOS - 1, SEEN), rng.integers(0, POINTS - 2, SEEN)
    half = PHOTOS + 2 * (photo % CAMERAS)
    derivatives = rng.normal(size=(SEEN, 2)), rng.normal(size=(SEEN, 2, 18)), rng.normal(size=(SEEN, 2, 3))
    still = bundle_of(np.zeros((POINTS, 3)), *ring(PHOTOS))
    return replace(still, photo=photo, point=point), derivatives, np.column_stack([photo, half, half + 1])


def test_points_are_eliminated_as_by_the_pseudoinverse_of_all_derivatives(measured):
    bundle, derivatives, blocks = measured
    used = np.arange(SEEN) % 7 > 0
    found = linearize(bundle, derivatives, blocks, UNKNOWNS, 2.0, depth=np.where(used, 1.0, -1.0))
    r, by_view, by_point, _ = weigh(*derivatives, used, 2.0)
    J, Jp = np.zeros((SEEN, 2, UNKNOWNS)), np.zeros((SEEN, 2, 3 * POINTS))
    for k in range(SEEN):
        J[k, :, (6 * blocks[k, :, None] + np.arange(6)).ravel()] = by_view[k].T
        Jp[k, :, 3 * bundle.point[k] + np.arange(3)] = by_point[k].T
    J, Jp = J.reshape(2 * SEEN, -1), Jp.reshape(2 * SEEN, -1)
    left = np.eye(2 * SEEN) - Jp @ np.linalg.pinv(Jp)

    assert np.allclose(found.eliminate_points().toarray(), J.T @ left @ J, atol=1e-9)
    assert np.allclose(found.drop_points(found.r), left @ r.ravel(), atol=1e-9)
    best = found.unwhiten(found.by_point.T @ found.r).ravel()
    assert np.allclose(Jp @ best, r.ravel() - left @ r.ravel(), atol=1e-9)
    assert found.used == used.sum() and found.rank.sum() == np.linalg.matrix_rank(Jp)


@pytest.mark.parametrize("cameras", [1, 3])
def test_scores_are_the_shares_of_the_photos_in_the_gradient(cameras):
    lenses = {"params": np.tile(CAMERA, (cameras, 1)), "camera": np.arange(6) % cameras}
    bundle = replace(bundle_of(box(), *ring(6)), family=np.tile(FAMILY, cameras), **lenses)
    found = reduce(bundle, SCALE_PX)
    observed, n = found.observed, 12 * cameras
    changes = np.column_stack([[*found.pose_step, *[0.0] * n], np.vstack([-found.pose_response, np.eye(n)])])
    moved = observed.by_view @ changes
    left, follow = np.split(observed.drop_points(np.column_stack([observed.r, moved])), [2], axis=1)
    products = (follow * (left[:, :1] - left[:, 1:])).reshape(-1, 2, n).sum(axis=1)
    expected = [products[bundle.photo == photo].sum(axis=0) for photo in range(6)]
    tolerance = 1e-9 * np.abs(found.scores).max()
    assert np.allclose(found.scores, expected, atol=tolerance) and np.allclose(sum(expected), found.g, atol=tolerance)


def observations(tracks):
    pairs = [(photo, point) for point, photos in enumerate(tracks) for photo in photos]
    return np.array(pairs, np.int64).reshape(-1, 2).T


@pytest.mark.parametrize("reach", [2, 5, 9])
@pytest.mark.parametrize("seed", [None, 0, 1])
def test_photos_along_a_street_are_tied_to_their_neighbors_whatever_their_numbers(reach, seed):
    names = np.arange(200) if seed is None else np.random.default_rng(seed).permutation(200)
    width = elimination_width(*observations([names[k : k + reach] for k in range(201 - reach)]))
    assert 0.9 * reach <= width <= reach


def test_photos_of_a_room_are_tied_to_all_of_a_ring_twice_as_wide_and_without_common_points_to_none():
    ring = [[k % 200, (k + 1) % 200, (k + 2) % 200] for k in range(200)]
    assert elimination_width(*observations([range(60)])) == pytest.approx(np.sqrt(np.mean(np.arange(1, 61) ** 2)))
    assert 4.0 <= elimination_width(*observations(ring)) <= 6.0
    assert elimination_width(*observations([[0], [1], [2]])) == 1.0
    assert elimination_width(np.zeros(0, np.int64), np.zeros(0, np.int64)) == 0.0
