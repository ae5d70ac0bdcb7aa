"""Whole sets of photos: groups, splits, claims, and what is left where nothing is known."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.selfcal import calibrate_photo_set, photo_set
from sfm_app.selfcal.pairs import guess_calibration
from sfm_app.selfcal.zero_curves import calibrate
from sfm_app.settings import CalibrationSettings
from sfm_app.types import PhotoPairs

pytestmark = pytest.mark.slow

OPTIONS = CalibrationSettings()
NO_PAIRS = PhotoPairs(np.empty((0, 3, 3)), np.empty(0), (), (), {}, {})


def cameras_of(pairs, together=True):
    return calibrate_photo_set(pairs, calibrate, OPTIONS, 0, together=together)


def unknown(pairs, options, seed):
    return guess_calibration(pairs.size, "an orbit", {})


def alone(count, size=(1000, 750), hints=None):
    """Photos of one group without any pair."""
    return replace(
        NO_PAIRS, sizes=dict.fromkeys(range(count), size), groups=dict.fromkeys(range(count), "one"),
        focal_hints_px=hints or {},
    )  # fmt: skip


def test_no_photos_are_no_cameras():
    assert cameras_of(NO_PAIRS) == []


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("count", [1, 5])
def test_photos_without_pairs_have_the_usual_guess(count, together):
    (camera,) = cameras_of(alone(count), together)
    assert (camera.name, camera.photos) == ("one", tuple(range(count)))
    assert (camera.found.method, camera.found.identifiable) == ("guess", False)
    assert camera.found.reason == "0 usable pairs, 3 are needed"
    assert camera.found.focal_px == pytest.approx(1200)


@pytest.mark.parametrize("together", [True, False])
def test_a_claim_comes_before_a_guess(together):
    (camera,) = cameras_of(alone(4, hints={1: 900.0, 2: 910.0, 3: 5000.0}), together)
    assert (camera.found.method, camera.found.focal_px) == ("exif", pytest.approx(910))
    assert (camera.found.identifiable, camera.found.radial, camera.found.spread) == (False, 0.0, {})


def test_what_the_pairs_determine_comes_before_a_wrong_claim(shots):
    made = shots(6, 1)
    (camera,) = cameras_of(made.as_set(["one"] * 6, dict.fromkeys(range(6), 3000.0)))
    assert camera.found.identifiable
    assert 0 < abs(camera.found.K[0, 0] - 1000) < 3 * camera.found.spread["fx"] < 30
    assert 0.1 < camera.found.evidence["support"] <= 1


def test_a_group_of_two_cameras_is_split(shots):
    focals = [1000.0] * 4 + [1500.0] * 4
    made = shots(8, 2, focal=focals)
    found = cameras_of(made.as_set(["zoom"] * 8))
    assert sorted(camera.name for camera in found) == ["zoom", "zoom #2"]
    assert sorted(camera.photos for camera in found) == [(0, 1, 2, 3), (4, 5, 6, 7)]
    for camera in found:
        assert camera.found.identifiable, camera.found.reason
        assert 0 < abs(camera.found.K[0, 0] / focals[camera.photos[0]] - 1) < 0.01


def test_without_together_groups_stay_what_they_are(shots):
    made = shots(8, 2, focal=[1000.0] * 4 + [1500.0] * 4)
    (camera,) = calibrate_photo_set(made.as_set(["zoom"] * 8), unknown, OPTIONS, 0, together=False)
    assert camera.photos == tuple(range(8))


def test_pairs_between_cameras_help_a_small_group(shots):
    sizes = [(1000, 750)] * 5 + [(800, 600)] * 2
    made = shots(7, 3, focal=[1000.0] * 5 + [950.0] * 2, size=sizes)
    pairs = made.as_set(["big"] * 5 + ["small"] * 2)

    alone_, together = cameras_of(pairs, together=False), cameras_of(pairs)

    assert [camera.name for camera in together] == ["big", "small"]
    assert [camera.photos for camera in together] == [(0, 1, 2, 3, 4), (5, 6)]
    assert not alone_[1].found.identifiable
    small = together[1].found
    assert small.identifiable, small.reason
    assert (small.width, small.height) == (800, 600)
    assert 0 < abs(small.K[0, 0] / 950 - 1) < 0.03
    assert 0 < abs(small.K[0, 0] - 950) < 3 * small.spread["fx"]


def test_a_group_without_pairs_beside_one_with(shots):
    made = shots(5, 4)
    pairs = made.as_set(["seen"] * 5)
    pairs = replace(
        pairs, sizes={**pairs.sizes, 5: (400, 300), 6: (400, 300)}, groups={**pairs.groups, 5: "lost", 6: "lost"},
        focal_hints_px={6: 333.0},
    )  # fmt: skip
    seen, lost = cameras_of(pairs)
    assert seen.found.identifiable
    assert (lost.found.method, lost.found.focal_px, lost.photos) == ("exif", pytest.approx(333), (5, 6))
    assert "0 usable pairs" in lost.found.reason


def test_cameras_with_most_photos_come_first():
    pairs = replace(
        NO_PAIRS,
        sizes={1: (64, 64), 2: (640, 480), 3: (640, 480), 4: (64, 64)},
        groups={1: "b", 2: "two", 3: "two", 4: "a"},
    )
    assert [camera.name for camera in calibrate_photo_set(pairs, unknown, OPTIONS, 0, together=False)] == [
        "two", "a", "b",
    ]  # fmt: skip


def test_every_photo_has_one_camera_and_every_camera_one_name(shots):
    made = shots(8, 5, focal=[1000.0] * 4 + [1500.0] * 4)
    found = cameras_of(made.as_set(["one"] * 7 + ["one #2"]))
    assert sorted(photo for camera in found for photo in camera.photos) == list(range(8))
    assert sorted(camera.name for camera in found) == ["one", "one #2", "one #3"]


def test_a_group_that_the_user_made_is_not_split(shots):
    made = shots(8, 1, focal=[1000.0] * 4 + [1500.0] * 4, points=250)
    ids = sorted({photo for pair in made.pairs.photos for photo in pair})
    pairs = PhotoPairs(
        made.pairs.Fs, made.pairs.weights, made.pairs.photos, made.pairs.inliers,
        dict.fromkeys(ids, made.pairs.size), dict.fromkeys(ids, "one"),
    )  # fmt: skip
    by_split = {
        split: calibrate_photo_set(pairs, calibrate, OPTIONS, 0, together=True, split=split) for split in (True, False)
    }
    assert [len(camera.photos) for camera in by_split[True]] == [4, 4]
    assert [len(camera.photos) for camera in by_split[False]] == [8]


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("error", [np.linalg.LinAlgError("Singular matrix"), ZeroDivisionError("division by zero")])
def test_a_calibrator_whose_numbers_fail_leaves_a_guess_with_the_reason(shots, together, error):
    def failing(*_):
        raise error

    cameras = calibrate_photo_set(shots(4, 1).as_set(["one"] * 4), failing, OPTIONS, 0, together=together)

    assert all(not camera.found.identifiable and camera.found.method == "guess" for camera in cameras)
    assert str(error) in cameras[0].found.reason


def test_cameras_that_cannot_be_compared_stay_what_they_are_alone(shots, monkeypatch):
    def failing(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(photo_set, "calibrate_cameras", failing)
    made = shots(6, 1).as_set(["one"] * 5 + ["two"])

    found = {camera.name: camera.found for camera in cameras_of(made)}

    assert found["one"].identifiable and found["one"].K[0, 0] == pytest.approx(1000, rel=0.03)
    assert not found["two"].identifiable and found["two"].method == "guess"


def of_two(shots, seed=2, most=4, focals=(1000.0, 1500.0)):
    """Two cameras of one size, with pairs that join them."""
    return shots(2 * most, seed, focal=[focals[0]] * most + [focals[1]] * most)


def test_photos_that_no_pair_gives_to_one_of_two_cameras_are_not_known(shots):
    made = of_two(shots)
    pairs = made.as_set(["one"] * 8)
    pairs = replace(pairs, sizes={**pairs.sizes, 8: pairs.sizes[0]}, groups={**pairs.groups, 8: "one"})

    found = {camera.photos: camera.found for camera in cameras_of(pairs)}

    assert found[0, 1, 2, 3].identifiable and found[4, 5, 6, 7].identifiable
    assert (found[8,].identifiable, found[8,].method) == (False, "guess")


def test_a_photo_whose_only_pair_leads_to_another_camera_is_not_known(shots):
    """Either of the two may be the odd one."""
    pairs = of_two(shots).as_set(["one"] * 8)
    kept = [k for k, (a, b) in enumerate(pairs.photos) if 0 not in (a, b) or (a, b) == (0, 7)]
    pairs = replace(
        pairs, Fs=pairs.Fs[kept], weights=pairs.weights[kept], photos=tuple(pairs.photos[k] for k in kept),
        inliers=tuple(pairs.inliers[k] for k in kept),
    )  # fmt: skip

    found = {camera.photos: camera.found for camera in cameras_of(pairs)}

    assert found[1, 2, 3].identifiable and found[4, 5, 6, 7].identifiable
    assert not found[0,].identifiable


def test_cameras_that_a_zoom_seems_to_have_are_estimates(shots):
    made = shots(12, 1, focal=[800.0] * 4 + [1100.0] * 4 + [1500.0] * 4, points=300)

    found = cameras_of(made.as_set(["zoom"] * 12))

    assert len(found) >= 3
    assert all(camera.found.method == "estimate" for camera in found), [camera.found.reason for camera in found]
    assert all("as those of a zoom do" in camera.found.reason for camera in found)


class FewerVotes(photo_set.VoteTables):
    """Tables without the first pair, as where its F repeats another's once its lens is taken out: copies of photos."""

    def __init__(self, Fs, members, weights):
        super().__init__(Fs, members, weights)
        self.kept, self.packed_rows, self.members, self.weights = (
            values[1:] for values in (self.kept, self.packed_rows, self.members, self.weights)
        )


def test_pairs_that_repeat_others_do_not_keep_two_cameras_together(shots, monkeypatch):
    monkeypatch.setattr(photo_set, "VoteTables", FewerVotes)
    made = shots(8, 2, focal=[1000.0] * 4 + [1500.0] * 4)
    found = cameras_of(made.as_set(["zoom"] * 8))
    assert sorted(camera.photos for camera in found) == [(0, 1, 2, 3), (4, 5, 6, 7)]
