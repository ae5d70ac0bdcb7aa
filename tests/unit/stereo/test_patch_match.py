"""Planes per pixel: they spread with their slopes, and cost much where there is nothing to be seen."""

import numpy as np
import pytest

from sfm_app.stereo.patch_match import NO_MATCH, improve_planes

pytestmark = pytest.mark.slow

CENTERS = [(0.5, 0, 0), (-0.4, 0.2, 0), (0, 0.5, 0.3)]


@pytest.fixture(scope="module")
def setting(plane, make_view):
    """A view, its photo and three neighbors with theirs."""
    view = make_view((0, 0, 0))
    others = [make_view(center, turn=(0.02, -0.03, 0.05)) for center in CENTERS]
    return view, plane.photo(view), [(other, plane.photo(other)) for other in others]


def improved(setting, planes, sweeps=2, image=None):
    view, photo, others = setting
    planes = planes.copy()
    return planes, improve_planes(planes, view, photo if image is None else image, others, sweeps)


def seeds(plane, view):
    """The true inverse depth, level, in every tenth row; nothing elsewhere."""
    planes = np.zeros((view.height, view.width, 3), np.float32)
    planes[10::10, 10:-10, 0] = 1 / plane.depth(view)[10::10, 10:-10]
    return planes


def test_the_plane_spreads_from_seeds(plane, setting):
    planes, cost = improved(setting, seeds(plane, setting[0]))

    inside = np.zeros(cost.shape, bool)
    inside[25:-25, 45:-45] = True
    known = inside & (cost < 0.5)
    error = np.abs(planes[..., 0] * plane.depth(setting[0]) - 1)[known]
    assert known.sum() > 0.95 * inside.sum()
    assert 1e-5 < np.median(error) < 4e-3  # 0.1 px of a disparity of 28 px


def test_more_sweeps_never_cost_more(plane, setting):
    (_, once), (_, twice) = (improved(setting, seeds(plane, setting[0]), sweeps) for sweeps in (1, 2))

    assert np.all(twice <= once)
    assert twice.mean() < once.mean()


def test_depths_far_from_the_truth_are_costly(plane, setting):
    wrong = np.zeros((*setting[1].shape, 3), np.float32)
    wrong[..., 0] = 2.0 / plane.depth(setting[0])
    wrong[:, 120:] = 0

    planes, cost = improved(setting, wrong, 1)

    lost = planes[..., 0] * plane.depth(setting[0]) > 1.2
    assert lost.sum() > 1000
    assert np.median(cost[lost]) > 0.5
    assert np.all(cost[planes[..., 0] == 0] == NO_MATCH)


def test_a_flat_photo_is_like_nothing(plane, setting):
    _, cost = improved(setting, seeds(plane, setting[0]), image=np.full_like(setting[1], 128))

    assert np.all(cost >= 0.95)


def test_one_hidden_view_does_not_matter(plane, setting):
    view, photo, others = setting
    hidden = [(others[0][0], np.zeros_like(others[0][1])), *others[1:]]
    planes = seeds(plane, view)

    cost = improve_planes(planes, view, photo, hidden, 2)

    assert np.median(cost[30:-30, 50:-50]) < 0.3


def test_same_input_gives_the_same_bytes(plane, setting):
    one, again = (improved(setting, seeds(plane, setting[0])) for _ in range(2))

    assert one[0].tobytes() == again[0].tobytes()
    assert one[1].tobytes() == again[1].tobytes()
