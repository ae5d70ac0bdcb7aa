import numpy as np
import pytest

from benchmarks.common.metrics import (
    CAP_PX,
    LOST_DEG,
    area_under_recall,
    fundamental_pose_error_deg,
    mean_sampson_px,
    summary_px,
)
from benchmarks.common.timing import take_turns
from sfm_app.camera.models import camera_matrix
from sfm_app.geometry.epipolar import fundamental_from_pose
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.synthetic.correspondences import PairOptions, make_pair

CAMERAS = (camera_matrix(700, 720, 250, 260), camera_matrix(900, 900, 300, 200))
T = np.array([0.6, 0.0, -0.8])
R = axis_rotation(np.array([0.0, 0.8, 0.6]), 20.0)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_true_matrix_has_no_pose_error(sign):
    F = sign * 3.7 * fundamental_from_pose(*CAMERAS, R, T)

    assert fundamental_pose_error_deg(F, CAMERAS, R, T) < 1e-5
    assert fundamental_pose_error_deg(F, CAMERAS, R, -5 * T) < 1e-5, "neither sign nor length of t is in F"


@pytest.mark.parametrize("off_deg", [1.0, 7.0])
def test_the_pose_error_is_the_larger_of_rotation_and_translation(off_deg):
    turned = axis_rotation(T, off_deg) @ R
    moved = axis_rotation(np.array([0.0, 1.0, 0.0]), 2 * off_deg) @ T

    assert fundamental_pose_error_deg(fundamental_from_pose(*CAMERAS, turned, T), CAMERAS, R, T) == pytest.approx(
        off_deg
    )
    both = fundamental_from_pose(*CAMERAS, turned, moved)
    assert fundamental_pose_error_deg(both, CAMERAS, R, T) == pytest.approx(2 * off_deg)


def test_no_matrix_is_lost():
    assert fundamental_pose_error_deg(None, CAMERAS, R, T) == LOST_DEG
    assert mean_sampson_px(None, np.zeros((1, 2)), np.zeros((1, 2))) == np.inf


@pytest.mark.parametrize(
    ("errors", "area"),
    [([0.0, 0.0], 1.0), ([180.0] * 3, 0.0), ([5.0], 0.75), ([5.0, 180.0], 0.375), ([2.0, 6.0], 0.75)],
)
def test_area_under_recall(errors, area):
    # recall rises linearly from error to error
    assert area_under_recall(np.array(errors), 10) == pytest.approx(area)


def test_failures_are_counted_and_capped():
    found = summary_px(np.array([0.1, 0.3, 80.0, np.inf]))

    assert found == {"mean px": 0.2, "capped mean px": (0.4 + 2 * CAP_PX) / 4, "failures": 2}
    assert summary_px(np.array([np.inf]))["mean px"] == CAP_PX


def test_methods_take_turns_after_a_warm_up_and_bad_matrices_are_no_answer():
    calls = []
    answers = {"good": np.eye(3), "nan": np.full((3, 3), np.nan), "stack": np.ones((9, 3)), "none": None}

    def named(name):
        return lambda *arguments: calls.append((name, arguments[2])) or (answers[name], 7)

    pairs = [make_pair(PairOptions(points=8), seed) for seed in range(2)]
    attempts = take_turns({name: named(name) for name in answers}, pairs, seed=40)

    assert calls == [(name, seed) for seed in (40, 40, 41) for name in answers]
    assert [[attempt.F is None for attempt in tries] for tries in attempts.values()] == [[False] * 2] + [[True] * 2] * 3
