"""Merging what neighbors say, and counting who agrees."""

import numpy as np

from sfm_app.stereo.depth import MIN_PATCH, count_confirming_maps, count_deeper_maps, filter_speckles, merge_hypotheses


def pixels(*values: float) -> np.ndarray:
    return np.array(values, np.float32).reshape(-1, 1, 1)


def test_the_company_wins_over_the_outlier():
    depth, support = merge_hypotheses(pixels(5.0, 2.0, 5.02), pixels(10, 12, 10), 0.01)

    assert support[0, 0] == 2
    assert 5.0 < depth[0, 0] < 5.02


def test_weights_are_squared_parallaxes_of_inverse_depths():
    depth, _ = merge_hypotheses(pixels(5.0, 5.04), pixels(30, 10), 0.01)

    np.testing.assert_allclose(depth[0, 0], 10 / (9 / 5.0 + 1 / 5.04), rtol=1e-6)


def test_no_hypothesis_gives_no_depth():
    depth, support = merge_hypotheses(pixels(0, 0), pixels(0, 0), 0.01)

    assert depth[0, 0] == 0
    assert support[0, 0] == 0


def test_the_order_of_the_neighbors_does_not_matter():
    rng = np.random.default_rng(0)
    depths = rng.uniform(4.95, 5.05, (3, 8, 9)).astype(np.float32)
    parallaxes = rng.uniform(5, 20, depths.shape).astype(np.float32)

    one, _ = merge_hypotheses(depths, parallaxes, 0.05)
    other, _ = merge_hypotheses(depths[::-1].copy(), parallaxes[::-1].copy(), 0.05)

    np.testing.assert_allclose(one, other, rtol=1e-6)


def test_true_depths_are_confirmed_and_wrong_ones_are_not(plane, make_view):
    view = make_view((0, 0, 0))
    others = [make_view((0.3, 0, 0)), make_view((-0.2, 0.1, 0.1), turn=(0.05, 0.02, 0.3))]
    maps = [(other, plane.depth(other)) for other in others]
    depth = plane.depth(view)
    depth[80:100, 100:140] *= 1.05
    depth[100:110, 100:140] = 0

    agreeing = count_confirming_maps(view, depth, maps, 0.01)

    assert not agreeing[80:110, 100:140].any()
    assert np.all(agreeing[30:70, 60:180] == 2)
    assert agreeing.max() == 2


def test_a_depth_behind_the_other_camera_is_not_confirmed(plane, make_view):
    view, ahead = make_view((0, 0, 0)), make_view((0, 0, 9))
    assert not count_confirming_maps(view, plane.depth(view), [(ahead, np.abs(plane.depth(ahead)))], 0.01).any()


def test_a_map_that_sees_something_behind_a_depth_is_counted(plane, make_view):
    view, other = make_view((0, 0, 0)), make_view((0.3, 0, 0))
    depth = plane.depth(view)
    depth[80:100, 100:140] *= 0.9  # the other photo sees the plane behind it
    depth[100:110, 100:140] *= 1.2
    depth[110:115] = 0

    deeper = count_deeper_maps(view, depth, [(other, plane.depth(other))], 0.05)

    assert deeper[80:100, 100:140].all()
    assert deeper.sum() == 20 * 40
    assert not count_deeper_maps(view, depth, [(other, np.zeros_like(depth))], 0.05).any()


def test_specks_go_and_thin_things_stay():
    depth = np.zeros((300, 400), np.float32)
    depth[50:250, 100:300] = np.linspace(4, 6, 200, dtype=np.float32)  # slanted: a pixel differs little from the next
    depth[100:104, 150:154] = 9.0  # hangs behind the surface
    depth[10:14, 10:14] = 5.0
    depth[280:282, 20:220] = 3.0

    found = filter_speckles(depth, 0.01)

    assert 16 < MIN_PATCH * depth.size < 400
    assert not found[100:104, 150:154].any()
    assert not found[10:14, 10:14].any()
    assert np.array_equal(found[280:282], depth[280:282])
    assert np.count_nonzero(found) == 200 * 200 - 16 + 400


def test_nothing_has_no_specks():
    empty = np.zeros((30, 40), np.float32)
    assert not filter_speckles(empty, 0.01).any()
