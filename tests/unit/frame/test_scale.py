"""Agreement of evidence of the scale; the frame of exported files."""

import json

import numpy as np
import pytest

from sfm_app.frame.scale import MetricFrame, ScaleEvidence, SurveyedPoint, agree, move_model
from sfm_app.geometry.poses import Similarity
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.types import MapPlace


def pieces(scales, deviation=0.01):
    return [ScaleEvidence(f"marker {k}", scale, deviation) for k, scale in enumerate(scales)]


def test_one_is_taken_as_it_is_and_none_leaves_the_unit_open():
    found = agree(pieces([2.0]))
    assert (found.from_model.scale, found.deviation) == pytest.approx((2.0, 0.01))
    assert found.contradictions == () and not agree([]).is_metric


def test_the_deviation_of_the_mean_covers_the_truth():
    rng, normalized = np.random.default_rng(0), []
    for _ in range(300):
        found = agree(pieces(3.0 * np.exp(0.01 * rng.normal(size=5))))
        normalized.append(np.log(found.from_model.scale / 3.0) / found.deviation)
    assert 0.6 < np.std(normalized) < 1.2


def test_a_wrong_one_among_three_is_named_and_left_out():
    found = agree(pieces([2.0, 2.01, 2.5]))
    assert found.from_model.scale == pytest.approx(2.005, rel=1e-3)
    assert found.source == "marker 0, marker 1" and len(found.evidence) == 3
    assert found.contradictions == ("marker 2 contradicts the 2 others: by it, the model is 25 % larger",)


def test_two_that_contradict_are_named_and_the_deviation_covers_half_of_the_difference():
    exact, vague = ScaleEvidence("marker 1", 2.0, 0.001), ScaleEvidence("GPS", 2.4, 0.02)
    found = agree([vague, exact])
    assert found.from_model.scale == 2.0
    assert found.deviation == pytest.approx(np.log(1.2) / 2)
    assert found.contradictions == ("GPS contradicts marker 1: by it, the model is 20 % larger",)


def test_scatter_that_is_larger_than_claimed_makes_the_deviation_larger():
    calm, wild = agree(pieces([2.0, 2.001])), agree(pieces([2.0, 2.1]))
    assert calm.deviation == pytest.approx(0.01 / np.sqrt(2), rel=0.01)
    assert 2 * calm.deviation < wild.deviation < 6 * calm.deviation


FRAME = MetricFrame(
    Similarity(3.5, axis_rotation(np.array([2.0, 6.0, 3.0]) / 7.0, 40.0), np.array([1.0, -2.0, 0.5])),
    0.001,
    "marker aruco-4x4 3",
    (ScaleEvidence("marker aruco-4x4 3", 3.5, 0.001, 4),),
    ("marker aruco-4x4 5 contradicts the 3 others",),
    MapPlace("EPSG:32632", (500_000.0, 4_649_000.0, 320.0), 12.0),
    (SurveyedPoint("p1", "used", 3, 0.01, -0.02), SurveyedPoint("CHK-1", "check", 2, 0.01, -0.07, 0.01, 0.02)),
)


@pytest.mark.parametrize("frame", [FRAME, MetricFrame()])
def test_a_frame_is_read_back_as_it_was_written(frame):
    again = MetricFrame.from_dict(json.loads(json.dumps(frame.to_dict())))
    assert again.to_dict() == frame.to_dict() and again.place == frame.place
    assert again.is_metric == again.changes == (frame is FRAME)
    assert again.surveyed == frame.surveyed


@pytest.mark.parametrize(
    ("plan", "height", "inside"), [(0.029, -0.059, True), (0.031, 0.0, False), (0.0, -0.061, False)]
)
def test_a_check_point_is_inside_three_deviations_in_plan_and_height(plan, height, inside):
    assert SurveyedPoint("CHK-1", "check", 2, plan, height, 0.01, 0.02).is_inside is inside


def test_moved_cameras_see_moved_points_where_they_saw_them(textured_ball):
    moved = move_model(textured_ball, FRAME.from_model)
    for before, after in zip(textured_ball.cameras, moved.cameras, strict=True):
        old = textured_ball.surface.vertices @ before.cam_from_world[:, :3].T + before.cam_from_world[:, 3]
        new = moved.surface.vertices @ after.cam_from_world[:, :3].T + after.cam_from_world[:, 3]
        assert np.allclose(new, 3.5 * old, atol=1e-9)
    assert np.array_equal(moved.surface.faces, textured_ball.surface.faces)
