"""Plain areas get the plane of their surroundings where other photos agree."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.stereo.plane_proposals import OPTIONS, agreed_proposals, propose_planes

HEIGHT, WIDTH = 240, 320
ROW, COL = np.mgrid[:HEIGHT, :WIDTH]
WALL = (1 / (0.2 + 2e-4 * COL - 1e-4 * ROW)).astype(np.float32)
"""Depth of a slanted wall."""
CORNER = (1 / (0.14 + 5e-4 * np.abs(COL - 150) - 1e-4 * (ROW - 120))).astype(np.float32)
"""Depth of two walls that meet."""
DOOR = (COL >= 80) & (COL < 240) & (ROW >= 60) & (ROW < 180)
CENTERS = [(0.3, 0, 0), (-0.3, 0.1, 0), (0, 0.3, 0.1), (0.1, -0.3, 0)]


def paint(plain: np.ndarray) -> np.ndarray:
    """A pattern, but for what is plain."""
    rng = np.random.default_rng(1)
    pattern = rng.integers(0, 255, (HEIGHT // 4, WIDTH // 4)).repeat(4, 0).repeat(4, 1)
    return np.where(plain, 90 + rng.normal(0, 1, COL.shape), pattern).astype(np.uint8)


def rough(depth: np.ndarray, noise: float = 0.002) -> np.ndarray:
    return (depth * (1 + np.random.default_rng(2).normal(0, noise, depth.shape))).astype(np.float32)


def test_a_door_of_which_only_the_frame_is_known_is_proposed():
    found = propose_planes(np.where(DOOR, np.float32(0), rough(WALL)), paint(DOOR), 0.02)

    assert not found[~DOOR].any()
    assert 0.9 < np.mean(found[DOOR] > 0) < 0.95  # but for its blurred outline
    assert 0 < np.abs(found / WALL - 1)[found > 0].max() < 1e-3


def test_two_walls_of_one_color_are_told_apart():
    found = propose_planes(np.where(DOOR, np.float32(0), rough(CORNER)), paint(DOOR), 0.02)

    assert np.mean(found[DOOR] > 0) > 0.9  # each wall lies between three sides of the frame
    error = np.abs(found / CORNER - 1)[found > 0]
    assert np.mean(error < 2e-3) > 0.95
    assert 2e-3 < error.max() < 0.05  # where they meet, the nearest frame decides


@pytest.mark.parametrize("side", [np.s_[:, 200:], np.s_[:, :120], np.s_[:100], np.s_[140:]])
def test_a_frame_that_is_open_to_two_sides_holds_nothing_there(side):
    depth = np.where(DOOR, np.float32(0), rough(WALL))
    depth[side] = 0

    found = propose_planes(depth, paint(DOOR), 0.02)

    inside = np.zeros(DOOR.shape, bool)
    inside[side] = True
    assert np.mean(found[inside & DOOR] > 0) < 0.05


@pytest.mark.parametrize(
    "depth",
    [np.zeros_like(WALL), np.where(DOOR, 0, rough(WALL, 0.3)), np.where(DOOR, 0, WALL + 0.002 * (ROW - 120) ** 2)],
    ids=["nothing known", "chance", "bent"],
)  # fmt: skip
def test_without_a_plane_nothing_is_proposed(depth):
    found = propose_planes(depth.astype(np.float32), paint(DOOR), 0.005)

    assert np.mean(found[DOOR] > 0) < 0.1


def test_a_dark_area_may_be_a_gate():
    depth = np.where(DOOR, np.float32(0), rough(WALL))
    gate = np.where(DOOR, np.uint8(30), paint(DOOR))  # the pattern has 127 in the median

    assert not propose_planes(depth, gate, 0.02).any()
    assert propose_planes(depth, np.where(DOOR, np.uint8(70), gate), 0.02).any()


def test_an_area_that_shows_something_is_left_to_matching():
    depth = np.where(DOOR, np.float32(0), WALL)

    assert not propose_planes(depth, paint(np.zeros(DOOR.shape, bool)), 0.02)[DOOR].any()


@pytest.fixture
def doors(plane, make_view):
    """Five photos of a plane, with a door in the middle of which each has only a proposal."""
    views = [make_view(center, sample_px=0.0) for center in [(0, 0, 0), *CENTERS]]
    found = []
    for view in views:
        depth, hole = plane.depth(view), np.zeros((view.height, view.width), bool)
        hole[60:120, 80:160] = True
        found.append((view, np.where(hole, np.float32(0), depth), np.where(hole, depth, np.float32(0))))
    return found


def test_what_others_propose_or_see_is_filled(doors, plane):
    (view, depth, proposed), *others = doors

    found = agreed_proposals(view, (depth, proposed), others, 0.01)

    np.testing.assert_allclose(found, plane.depth(view), rtol=1e-6)


def test_too_few_others_are_no_proof(doors):
    (view, depth, proposed), *others = doors

    for count in range(OPTIONS.least_agreeing):
        np.testing.assert_array_equal(agreed_proposals(view, (depth, proposed), others[:count], 0.01), depth)
    assert agreed_proposals(view, (depth, proposed), others[: OPTIONS.least_agreeing], 0.01).all()


def test_what_one_photo_sees_through_is_an_opening(doors, plane):
    (view, depth, proposed), *others = doors
    behind = replace(plane, distance=plane.distance * 1.1)
    other = others[0][0]
    through = np.where(others[0][2] > 0, behind.depth(other), np.float32(0))
    seeing = [(other, through, np.zeros_like(through)), *others[1:]]

    found = agreed_proposals(view, (depth, proposed), seeing, 0.01)

    assert np.mean(found[65:115, 95:145] > 0) < 0.05
    np.testing.assert_array_equal(found[proposed == 0], depth[proposed == 0])


def test_a_run_that_goes_on_finds_the_same(doors):
    """Others that have been filled already count as before."""
    first = [
        agreed_proposals(view, (depth, proposed), [d for d in doors if d[0] is not view], 0.01)
        for view, depth, proposed in doors
    ]
    filled = [(view, depth, proposed) for (view, _, proposed), depth in zip(doors, first, strict=True)]

    for (view, depth, proposed), before in zip(filled, first, strict=True):
        others = [one for one in filled if one[0] is not view]
        np.testing.assert_array_equal(agreed_proposals(view, (depth, proposed), others, 0.01), before)
