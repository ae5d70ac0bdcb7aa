"""Photos of one size that are of one camera, of two, or each of its own."""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.selfcal.groups import VoteTables
from sfm_app.selfcal.other_cameras import FocalGrid, divide_photos, log_probability
from sfm_app.selfcal.pairs import LOG_FOCAL

slow = pytest.mark.slow

MIDDLE = np.array([[1e3, 0, 500], [0, 1e3, 375], [0, 0, 1]])
UNLIKE = 1000 * np.geomspace(0.7, 1.75, 10)
"""Ten focals, the last 2.5 times the first."""


def divide(made, Fs=None, *, kept=None, known=None, seed=0, mixed=False):
    """The division of photos of 1000 x 750 pixels; `kept`: pairs that are there."""
    Fs = MIDDLE.T @ (made.pairs.Fs if Fs is None else Fs) @ MIDDLE
    rows = [k for k in range(len(Fs)) if kept is None or kept(*made.pairs.photos[k])]
    tables = VoteTables(Fs[rows], np.zeros((len(rows), 2), np.int64), made.pairs.weights[rows])
    return divide_photos(tables, [made.pairs.photos[k] for k in rows], [np.zeros(5)], seed, known, mixed=mixed)


def labels_of(division):
    """Numbers of the cameras in the order of the photos; the first photo has number 0."""
    labels = [division.labels[photo] for photo in sorted(division.labels)]
    return [label ^ labels[0] for label in labels]


def with_wrong(Fs, share, rng):
    """Some of the matrices as if they were of other cameras, up to 2.7 times longer or shorter."""
    found = Fs.copy()
    for k in rng.permutation(len(Fs))[: round(share * len(Fs))]:
        scale = np.diag([1.0, 1.0, np.exp(rng.uniform(-1, 1))])
        change = MIDDLE @ scale @ np.linalg.inv(MIDDLE)
        found[k] = change.T @ Fs[k] @ change
    return found


@slow
@pytest.mark.parametrize("share", [0.0, 0.2, 0.4])
@pytest.mark.parametrize("count", [3, 6, 9])
def test_photos_of_one_camera_are_not_divided(shots, share, count):
    for seed in range(6):
        made = shots(count, 300 + seed, noise_px=1.5, points=120)
        found = divide(made, with_wrong(made.pairs.Fs, share, np.random.default_rng(seed)))
        assert set(found.labels.values()) == {0}
        assert not found.is_camera_per_photo


@slow
def test_matrices_of_another_camera_do_not_divide_photos(shots):
    for seed in range(10):
        made, other = shots(8, seed, points=120), shots(8, seed + 50, focal=1700.0, points=120)
        Fs = made.pairs.Fs.copy()
        most = min(len(Fs), len(other.pairs.Fs))
        wrong = np.random.default_rng(seed).permutation(most)[: most // 3]
        Fs[wrong] = other.pairs.Fs[wrong]
        assert set(divide(made, Fs).labels.values()) == {0}


def test_errors_that_the_pairs_of_a_photo_share_do_not_divide_photos(shots):
    """A moving object in a few photos gives them a focal of their own; other wrong pairs stay as they are."""
    for seed in range(4):
        made, rng = shots(8, 330 + seed, points=120), np.random.default_rng(seed)
        Fs = with_wrong(made.pairs.Fs, 0.4, rng)
        longer = MIDDLE @ np.diag([1.0, 1.0, 1.6]) @ np.linalg.inv(MIDDLE)
        for k, pair in enumerate(made.pairs.photos):
            if pair[0] == made.pairs.photos[0][0] and rng.random() < 0.7:
                Fs[k] = made.pairs.Fs[k] @ longer
        assert set(divide(made, Fs).labels.values()) == {0}


@slow
@pytest.mark.parametrize("focal", [UNLIKE, 1000.0], ids=["a camera each", "one camera"])
def test_in_a_mixed_folder_photos_with_many_wrong_pairs_are_divided_if_focals_differ(shots, focal):
    """Equal sides of a building match, so that no cameras explain most of the rest."""
    divided = {True: 0, False: 0}
    for seed in range(4):
        made = shots(10, 350 + seed, focal=focal, points=120)
        Fs = with_wrong(made.pairs.Fs, 0.65, np.random.default_rng(seed))
        for mixed in divided:
            divided[mixed] += divide(made, Fs, mixed=mixed).is_camera_per_photo
    assert divided[True] == (4 if focal is UNLIKE else 0) and divided[False] <= 2 * divided[True] / 4


@slow
def test_two_cameras_of_a_mixed_folder_stay_two(shots):
    for seed in range(4):
        made = shots(8, seed, focal=[1000.0] * 4 + [1500.0] * 4, points=120)
        assert labels_of(divide(made, mixed=True)) == [0] * 4 + [1] * 4


@slow
@pytest.mark.parametrize("motion", ["orbit", "parallel", "onward", "turning"])
def test_motions_that_leave_the_focal_open_do_not_divide_photos(shots, motion):
    for seed in range(4):
        found = divide(shots(8, 310 + seed, motion=getattr(shots, motion), noise_px=1.0, points=120))
        assert set(found.labels.values()) == {0}


@slow
@pytest.mark.parametrize("ratio", [1.5, 1.25, 0.8, 0.6])
@pytest.mark.parametrize("share", [0.0, 0.2])
def test_photos_of_two_cameras_are_divided(shots, ratio, share):
    right = 0
    for seed in range(6):
        made = shots(8, seed, focal=[1000.0] * 4 + [1000.0 * ratio] * 4, points=120)
        found = divide(made, with_wrong(made.pairs.Fs, share, np.random.default_rng(seed)))
        right += labels_of(found) == [0] * 4 + [1] * 4
        if len(found.cameras) == 2:
            first, second = np.exp(found.cameras[[found.labels[0], found.labels[7]], LOG_FOCAL])
            assert second / first == pytest.approx(ratio, rel=0.1)
    assert right >= 5


@slow
def test_one_zoomed_photo_of_eight_is_another_camera(shots):
    right = 0
    for seed in range(8):
        made = shots(8, seed, focal=[1000.0] * 7 + [1500.0], points=120)
        right += labels_of(divide(made)) == [0] * 7 + [1]
    assert right >= 7


@slow
@pytest.mark.parametrize("ratio", [1.5, 0.65])
def test_two_cameras_with_hardly_any_common_pair_are_divided(shots, ratio):
    """No photo alone wants another focal: all that it shares pairs with would have to change with it."""
    right = 0
    for seed in range(4):
        made = shots(12, seed, focal=[1000.0] * 7 + [1000.0 * ratio] * 5, points=500)
        two = divide(made, kept=lambda a, b: (a < 7) == (b < 7) or (a, b) == (6, 7))
        right += labels_of(two) == [0] * 7 + [1] * 5
    assert right >= 3


@slow
def test_photos_of_unlike_cameras_have_a_camera_each(shots):
    right = 0
    for seed in range(8):
        focals = np.random.default_rng(seed).permutation(UNLIKE)
        made = shots(10, 320 + seed, focal=focals, noise_px=1.0, points=200)
        right += divide(made).is_camera_per_photo
    assert 7 <= right <= 8


@slow
def test_known_cameras_that_explain_the_pairs_stay(shots):
    for seed in range(4):
        made = shots(10, 330 + seed, focal=[1000.0] * 5 + [1600.0] * 5, points=200)
        halves = {photo: 7 * int(photo >= 5) for photo in range(10)}
        assert labels_of(divide(made, known=halves)) == [0] * 5 + [1] * 5
        assert divide(made, known=dict.fromkeys(range(10), 3)).is_camera_per_photo


@slow
def test_the_answer_is_the_same_for_every_order_of_the_cameras_of_a_pair(shots):
    made = shots(10, 321, focal=UNLIKE, points=200)
    turned = replace(made, pairs=replace(made.pairs, photos=tuple(pair[::-1] for pair in made.pairs.photos)))
    first, second = divide(made), divide(turned, made.pairs.Fs.transpose(0, 2, 1))
    assert first.labels == second.labels
    np.testing.assert_allclose(first.cameras, second.cameras, atol=1e-9)


def test_one_pair_is_no_reason_to_divide(shots):
    found = divide(shots(2, 1))
    assert found.labels == {0: 0, 1: 0}
    assert len(found.cameras) == 1 and not found.is_camera_per_photo


def test_probabilities_of_divisions_add_to_one():
    """All ways to divide four photos: one of 4, four of 3 + 1, three of 2 + 2, six of 2 + 1 + 1, one of singles."""
    ways = [([0, 0, 0, 0], 1), ([0, 0, 0, 1], 4), ([0, 0, 1, 1], 3), ([0, 0, 1, 2], 6), ([0, 1, 2, 3], 1)]
    assert sum(count * np.exp(log_probability(np.array(labels))) for labels, count in ways) == pytest.approx(1.0)


def test_no_photo_would_rather_have_the_other_of_two_cameras():
    rng, photos = np.random.default_rng(0), 9
    members = np.array([pair for pair in combinations(range(photos), 2) if rng.uniform() < 0.6])
    tables = SimpleNamespace(weights=np.ones(len(members)), votes=lambda *_: rng.exponential(0.03, 81**2))
    grid = FocalGrid(tables, np.arange(len(members)), np.zeros(5), members)
    for cut in range(1, photos):
        places = rng.integers(81, size=2)

        def log_odds(labels, places=places):
            gains = grid.gains[np.arange(len(members)), *places[labels[members]].T]
            return gains.sum() + log_probability(labels)

        labels = grid.assign(places, (np.arange(photos) < cut).astype(np.int64))
        assert log_odds(labels) >= log_odds((np.arange(photos) < cut).astype(np.int64))
        for photo in range(photos):
            other = labels.copy()
            other[photo] = 1 - other[photo]
            assert log_odds(other) <= log_odds(labels) + 1e-9
