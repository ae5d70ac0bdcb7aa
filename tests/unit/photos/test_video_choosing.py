"""Frames of a texture that slides by: how far it has moved is known to the pixel."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.photos.video import CornerTracker, TrackedFrame, select_keyframes

pytestmark = pytest.mark.slow

SIZE = WIDTH, HEIGHT = 240, 160
STEP_PX = 0.05 * WIDTH


@pytest.fixture(scope="module")
def wall():
    """A wide texture."""
    blots = np.random.default_rng(1).integers(0, 255, (HEIGHT, 2400)).astype(np.uint8)
    return cv2.GaussianBlur(blots, (0, 0), 2.0)


def film(wall, places, blurred=(), noise=0.0):
    """What frames from these places show."""
    rng = np.random.default_rng(2)
    for k, at in enumerate(places):
        shift = np.array([[1.0, 0.0, -at], [0.0, 1.0, 0.0]])
        frame = cv2.warpAffine(wall, shift, SIZE, flags=cv2.INTER_LINEAR).astype(np.float64)
        if k in blurred:
            frame = cv2.GaussianBlur(frame, (0, 0), 3.0)
        yield np.clip(frame + rng.normal(0, noise, frame.shape), 0, 255).astype(np.uint8)


def looks_at(frames):
    follower = CornerTracker()
    return [follower.track(k, frame) for k, frame in enumerate(frames)]


@pytest.fixture(scope="module")
def slide(wall):
    """FaceViews at 600 pixels of the way, three for each frame."""
    return looks_at(film(wall, np.arange(0, 600, 3.0)))


def chosen_from(frames, most=100):
    return list(select_keyframes(looks_at(frames), most).frames)


@pytest.mark.parametrize("speed_px", [0.7, 2.5, 5.0])
def test_frames_are_one_step_apart(wall, speed_px):
    places = np.arange(0, 60 + 100 * speed_px, speed_px)

    gaps = np.diff(places[chosen_from(film(wall, places))])

    assert gaps.min() >= 0.5 * STEP_PX - speed_px
    assert gaps.max() <= 1.5 * STEP_PX + speed_px
    assert 0.9 * STEP_PX < gaps.mean() < 1.1 * STEP_PX


@pytest.mark.parametrize(
    ("speed_px", "blurred"), [(2.0, range(1, 400, 2)), (2.0, range(40, 44)), (9.0, range(1, 99, 2))]
)
def test_a_blurred_frame_is_not_chosen_beside_a_sharp_one(wall, speed_px, blurred):
    places = np.arange(0, 300, speed_px)

    chosen = chosen_from(film(wall, places, blurred))

    assert not set(chosen) & set(blurred)
    assert len(chosen) >= 0.9 * 300 / max(STEP_PX, 2 * speed_px)


def test_where_all_is_blurred_the_overlap_is_kept(wall):
    places = np.arange(0, 400, 4.0)
    blurred = range(30, 75)

    chosen = chosen_from(film(wall, places, blurred))

    assert any(k in blurred for k in chosen)
    assert np.diff(places[chosen]).max() < 2.5 * STEP_PX


@pytest.mark.parametrize("noise", [0.0, 10.0])
def test_a_camera_that_stands_gives_one_frame(wall, noise):
    shaking = 300 + np.random.default_rng(3).uniform(-2.0, 2.0, 150)

    assert len(chosen_from(film(wall, shaking, range(40, 60), noise))) == 1


def test_a_rest_adds_nothing(wall):
    ways = np.arange(0, 200, 4.0), np.arange(200, 400, 4.0)
    rest = np.full(120, 200.0)

    without = chosen_from(film(wall, np.concatenate(ways)))
    resting = chosen_from(film(wall, np.concatenate([ways[0], rest, ways[1]]), noise=3.0))

    assert abs(len(resting) - len(without)) <= 1
    assert sum(len(ways[0]) <= k < len(ways[0]) + len(rest) for k in resting) <= 1


@pytest.mark.parametrize("most", [2, 5, 17])
def test_no_more_than_wanted_and_evenly(slide, most):
    places = np.arange(0, 600, 3.0)

    choice = select_keyframes(slide, most)
    gaps = np.diff(places[list(choice.frames)])

    assert len(choice.frames) == most
    assert gaps.max() < 600 / (most - 1) + STEP_PX + 3
    assert gaps.min() > 0.5 * 600 / (most - 1) - STEP_PX
    assert choice.left_out["more than max_frames"] == pytest.approx(
        len(select_keyframes(slide, 2000).frames) - most, abs=most
    )


def test_every_shot_of_a_cut_video_is_seen(wall):
    shots = np.repeat([0.0, 700.0, 1400.0], 20)

    chosen = chosen_from(film(wall, shots))

    assert [k // 20 for k in chosen] == [0, 1, 2]


def test_where_every_frame_shows_something_else_all_are_taken(wall):
    assert chosen_from(film(wall, np.arange(0, 2000, 130.0))) == list(range(16))


def test_forward_and_back_counts_both_ways(wall):
    there = np.arange(0, 240, 3.0)

    chosen = chosen_from(film(wall, np.concatenate([there, there[::-1]])))

    assert 2 * 240 / STEP_PX - 3 <= len(chosen) <= 2 * 240 / STEP_PX + 1


@pytest.mark.parametrize("value", [0, 255])
def test_an_empty_picture_shows_nothing_to_follow(value):
    follower = CornerTracker()
    looks = [follower.track(k, np.full((HEIGHT, WIDTH), value, np.uint8)) for k in range(5)]

    assert not follower.has_texture
    assert [look.path_steps for look in looks] == [0.0] * 5


def test_the_same_frames_give_the_same_choice(wall):
    places = np.arange(0, 150, 3.0)

    first, second = (looks_at(film(wall, places, noise=4.0)) for _ in range(2))

    assert first == second
    assert select_keyframes(first, 9) == select_keyframes(second, 9)


@given(st.lists(st.tuples(st.floats(0, 1e5), st.floats(-0.9, 1.2)), min_size=1, max_size=60), st.integers(2, 20))
def test_any_looks_give_a_choice_in_order(steps, most):
    way = np.maximum(0.0, np.cumsum([step for _, step in steps]) - steps[0][1])
    looks = [TrackedFrame(3 * k, sharp, float(at)) for k, ((sharp, _), at) in enumerate(zip(steps, way, strict=True))]

    choice = select_keyframes(looks, most)

    assert 1 <= len(choice.frames) <= most
    assert list(choice.frames) == sorted(set(choice.frames))
    assert set(choice.frames) <= {look.frame for look in looks}
    assert len(choice.frames) + sum(choice.left_out.values()) == len(looks)
    assert min(choice.left_out.values(), default=1) > 0


def test_no_looks_no_frames():
    assert select_keyframes([], 10).frames == ()
