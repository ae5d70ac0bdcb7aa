"""What a depth map says about points."""

from dataclasses import dataclass

import numpy as np
import pytest

from sfm_app.meshing.visibility import CONFIRMED, EMPTY, NO_EVIDENCE, SEEN_THROUGH, SKY, judge
from sfm_app.types import PosedPhoto

FACING = np.array([[0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Eye:
    """A photo and its depth map."""

    photo: PosedPhoto
    depth: np.ndarray

    def judge(self, points, normals):
        return judge(points, normals, self.photo, self.depth, 0.5, 0.01)


@pytest.fixture
def eye():
    """It looks along +z at a wall 10 away, that is empty on the right and 5 away at the bottom."""
    depth = np.full((60, 80), 10.0, np.float32)
    depth[:, 60:] = 0
    depth[40:] = 5
    K = np.array([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])
    return Eye(PosedPhoto("", K, np.eye(3, 4), 80, 60), depth)


@pytest.mark.parametrize(
    ("point", "verdict"),
    [
        ((0, 0, 10.0), CONFIRMED),
        ((0, 0, 9.95), CONFIRMED),
        ((0, 0, 9.8), NO_EVIDENCE),
        ((0, 0, 9.0), SEEN_THROUGH),
        ((0, 0, 11.0), NO_EVIDENCE),
        ((3, 0, 10.0), EMPTY),
        ((0, 1.0, 5.0), CONFIRMED),
        ((0, 0.745, 7.4), NO_EVIDENCE),  # on the step from 10 to 5
        ((0, 0, -10.0), NO_EVIDENCE),
        ((9, 0, 10.0), NO_EVIDENCE),
    ],
)
def test_verdicts(eye, point, verdict):
    assert eye.judge(np.array([point]), FACING) == verdict


def test_the_back_of_a_surface_is_not_confirmed(eye):
    assert eye.judge(np.array([[0, 0, 10.0]]), -FACING) == NO_EVIDENCE
    assert eye.judge(np.array([[3, 0, 10.0]]), -FACING) == NO_EVIDENCE


def test_what_is_masked_says_nothing(eye):
    """Where a photo is empty it speaks against a surface; where it is masked it does not."""
    eye.depth[:20, 60:] = -1
    points = np.array([[3, -1.5, 10.0], [3, 0, 10.0], [1.95, -1.5, 10.0], [1.95, -1.5, 9.0]])

    verdict = eye.judge(points, FACING.repeat(4, axis=0))

    assert verdict.tolist() == [NO_EVIDENCE, EMPTY, CONFIRMED, NO_EVIDENCE]


def test_what_stands_before_the_sky_is_seen_through_from_both_sides(eye):
    """The depth of the pixel beside it confirms nothing."""
    eye.depth[:20, 60:] = SKY
    points = np.array([[3, -1.5, 10.0], [0.6, -0.3, 2.0], [2.01, -1.5, 10.0], [1.99, -1.5, 10.0]])

    for facing, beside in ((FACING, CONFIRMED), (-FACING, NO_EVIDENCE)):
        verdict = eye.judge(points, facing.repeat(4, axis=0))

        assert verdict.tolist() == [SEEN_THROUGH, SEEN_THROUGH, SEEN_THROUGH, beside]
