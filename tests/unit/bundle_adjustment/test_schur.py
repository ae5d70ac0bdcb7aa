"""Points eliminated one by one, beside the same with dense matrices."""

import numpy as np
import pytest

from sfm_app.bundle.normal_equations import Linearized, eliminate_points

PHOTOS, CAMERAS, POINTS, SEEN, DAMPING = 5, 3, 20, 60, 1e-3


@pytest.fixture
def bundle():
    """Observations in any order, some points twice in a photo or never, photos of several cameras, one of none."""
    rng = np.random.default_rng(0)
    photo = rng.integers(0, PHOTOS - 1, SEEN)
    point = rng.integers(0, POINTS - 2, SEEN)
    by_point = np.zeros((SEEN, 2, 3))
    for p in np.unique(point):
        rows = np.flatnonzero(point == p)
        columns = min(3, 2 * len(rows))
        by_point[rows, :, :columns] = np.linalg.qr(rng.normal(size=(2 * len(rows), columns)))[0].reshape(-1, 2, columns)
    by_view = rng.normal(size=(SEEN, 2, 18))
    return Linearized(photo, photo % CAMERAS, point, by_view, by_point, (PHOTOS, CAMERAS, POINTS))


def dense(bundle):
    """The derivatives by all poses and cameras, and by all points."""
    J, Jp = np.zeros((SEEN, 2, 6 * PHOTOS + 12 * CAMERAS)), np.zeros((SEEN, 2, 3 * POINTS))
    for k in range(SEEN):
        first = 6 * bundle.photo[k], 6 * PHOTOS + 12 * bundle.camera[k]
        J[k, :, first[0] : first[0] + 6] = bundle.by_view[k, :, :6]
        J[k, :, first[1] : first[1] + 12] = bundle.by_view[k, :, 6:]
        Jp[k, :, 3 * bundle.point[k] : 3 * bundle.point[k] + 3] = bundle.by_point[k]
    return J.reshape(2 * SEEN, -1), Jp.reshape(2 * SEEN, -1)


def test_the_matrix_is_that_of_all_derivatives_without_the_points(bundle):
    J, Jp = dense(bundle)
    expected = J.T @ J - J.T @ Jp @ Jp.T @ J + DAMPING * np.eye(J.shape[1])

    S, rows = eliminate_points(bundle, DAMPING)

    assert np.allclose(S.toarray(), expected[: 6 * PHOTOS, : 6 * PHOTOS], atol=1e-12)
    assert np.allclose(rows, expected[6 * PHOTOS :], atol=1e-12)


def test_products_are_those_of_all_derivatives(bundle):
    J, Jp = dense(bundle)
    rng = np.random.default_rng(1)
    values, change = rng.normal(size=(SEEN, 2)), rng.normal(size=J.shape[1])

    moved = bundle.move(change[: 6 * PHOTOS], change[6 * PHOTOS :])

    assert np.allclose(bundle.sum_by_point(values).ravel(), Jp.T @ values.ravel(), atol=1e-12)
    assert np.allclose(bundle.sum_by_view(values), J.T @ values.ravel(), atol=1e-12)
    assert np.allclose(bundle.drop_points(values).ravel(), values.ravel() - Jp @ Jp.T @ values.ravel(), atol=1e-12)
    assert np.allclose(moved.ravel(), J @ change, atol=1e-12)
    assert np.allclose(bundle.camera_squares(), (J[:, 6 * PHOTOS :] ** 2).sum(axis=0), atol=1e-12)


def test_scores_are_the_shares_of_the_photos_in_what_is_left(bundle):
    J, Jp = dense(bundle)
    rng = np.random.default_rng(2)
    give, left_over = rng.normal(size=(6 * PHOTOS, 12 * CAMERAS)), rng.normal(size=(SEEN, 2))
    follow = J @ np.vstack([-give, np.eye(12 * CAMERAS)])
    products = (follow - Jp @ Jp.T @ follow) * left_over.ravel()[:, None]
    expected = [products.reshape(SEEN, 2, -1)[bundle.photo == i].sum(axis=(0, 1)) for i in range(PHOTOS)]

    assert np.allclose(bundle.score(give, left_over), expected, atol=1e-12)


def test_a_bundle_of_nothing_leaves_the_damping():
    none = np.empty(0, np.int64)
    empty = Linearized(none, none, none, np.zeros((0, 2, 18)), np.zeros((0, 2, 3)), (2, 1, 0))

    S, rows = eliminate_points(empty, DAMPING)

    assert np.array_equal(S.toarray(), DAMPING * np.eye(12))
    assert np.array_equal(rows, DAMPING * np.eye(24)[12:])
