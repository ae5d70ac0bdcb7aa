"""Whole sets of photos: groups, splits, claims, and guesses."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.selfcal import calibrate_photo_set, photo_set
from sfm_app.selfcal.pairs import guess_calibration
from sfm_app.selfcal.zero_curves import calibrate
from sfm_app.settings import CalibrationSettings
from sfm_app.types import CameraPrior, PhotoPairs

pytestmark = pytest.mark.slow

OPTIONS = CalibrationSettings()
UNLIKE = 1000 * np.geomspace(0.7, 1.75, 10)
"""Ten focals, the last 2.5 times the first."""
NO_PAIRS = PhotoPairs(np.empty((0, 3, 3)), np.empty(0), (), (), {}, {})


def cameras_of(pairs, together=True):
    return calibrate_photo_set(pairs, calibrate, OPTIONS, 0, together=together)


def unknown(pairs, options, seed):
    return guess_calibration(pairs.size, "an orbit", {})


def alone(count, size=(1000, 750), priors=None):
    """Photos of one group without any pair."""
    return replace(
        NO_PAIRS, sizes=dict.fromkeys(range(count), size), groups=dict.fromkeys(range(count), "one"),
        priors=priors or {},
    )  # fmt: skip


def of_two(shots):
    """Four photos of each of two cameras of one size, with pairs that join them."""
    return shots(8, 2, focal=[1000.0] * 4 + [1500.0] * 4)


def test_cameras_of_other_inliers_are_adjusted_but_not_divided_again(shots):
    def never(*_):
        raise AssertionError("a group is calibrated again")

    pairs, first = of_two(shots).as_set(["zoom"] * 8), cameras_of(of_two(shots).as_set(["zoom"] * 8))
    fewer = replace(pairs, inliers=tuple(x[::2] for x in pairs.inliers))
    again = calibrate_photo_set(fewer, never, OPTIONS, 0, together=True, before=first)
    assert [(one.name, one.photos) for one in again] == [(one.name, one.photos) for one in first]
    for one, other in zip(first, again, strict=True):
        assert 0 < abs(other.found.focal_px - one.found.focal_px) < 3 * other.found.spread["fx"]


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("count", [1, 5])
def test_photos_without_pairs_have_the_usual_guess(count, together):
    (camera,) = cameras_of(alone(count), together)
    assert (camera.name, camera.photos) == ("one", tuple(range(count)))
    assert (camera.found.method, camera.found.identifiable) == ("guess", False)
    assert camera.found.reason == "0 usable pairs, 3 are needed"
    assert camera.found.focal_px == pytest.approx(1200)


def test_two_cameras_without_pairs_have_the_usual_guess_too():
    cameras = cameras_of(replace(alone(4), groups=dict(enumerate("aabb"))))
    assert [(one.name, one.photos, one.found.method) for one in cameras] == [
        ("a", (0, 1), "guess"),
        ("b", (2, 3), "guess"),
    ]


@pytest.mark.parametrize("together", [True, False])
def test_a_claim_comes_before_a_guess(together):
    claims = [CameraPrior("EXIF", focal, 40.0, (480.0, 375.0), 9.0) for focal in (900.0, 910.0, 5000.0)]
    (camera,) = cameras_of(alone(4, priors=dict(enumerate(claims))), together)
    assert (camera.found.method, camera.found.focal_px) == ("claim", pytest.approx(910))
    assert (camera.found.identifiable, camera.found.K[0, 2]) == (False, 480.0)
    assert camera.found.spread == {"fx": 40.0, "fy": 40.0, "cx": 9.0, "cy": 9.0}
    assert camera.found.reason == "0 usable pairs, 3 are needed; EXIF claims this one"


def test_the_deviation_of_a_claim_covers_the_scatter_between_photos():
    claims = [CameraPrior("a net", focal, 10.0) for focal in (800.0, 1000.0, 1300.0)]
    (camera,) = cameras_of(alone(3, priors=dict(enumerate(claims))))
    assert camera.found.focal_px == pytest.approx(1000)
    assert 200 < camera.found.spread["fx"] < 400


def test_pairs_come_before_a_wrong_claim(shots):
    made = shots(6, 1)
    (camera,) = cameras_of(made.as_set(["one"] * 6, dict.fromkeys(range(6), CameraPrior("a net", 3000.0, 60.0))))
    assert camera.found.identifiable
    assert 0 < abs(camera.found.K[0, 0] - 1000) < 3 * camera.found.spread["fx"] < 30
    assert 0.1 < camera.found.evidence["support"] <= 1


def test_a_group_of_two_cameras_is_split(shots):
    focals, found = [1000.0] * 4 + [1500.0] * 4, cameras_of(of_two(shots).as_set(["zoom"] * 8))
    assert sorted(camera.name for camera in found) == ["zoom", "zoom #2"]
    assert sorted(camera.photos for camera in found) == [(0, 1, 2, 3), (4, 5, 6, 7)]
    for camera in found:
        assert camera.found.identifiable, camera.found.reason
        assert 0 < abs(camera.found.K[0, 0] / focals[camera.photos[0]] - 1) < 0.01


def test_without_together_groups_are_not_split(shots):
    (camera,) = calibrate_photo_set(of_two(shots).as_set(["zoom"] * 8), unknown, OPTIONS, 0, together=False)
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
        priors={6: CameraPrior("EXIF", 333.0, 13.0)},
    )  # fmt: skip
    seen, lost = cameras_of(pairs)
    assert seen.found.identifiable
    assert (lost.found.method, lost.found.focal_px, lost.photos) == ("claim", pytest.approx(333), (5, 6))
    assert "0 usable pairs" in lost.found.reason


def test_cameras_with_most_photos_come_first():
    groups = {1: "b", 2: "two", 3: "two", 4: "a"}
    pairs = replace(NO_PAIRS, sizes=dict.fromkeys(groups, (64, 64)), groups=groups)
    cameras = calibrate_photo_set(pairs, unknown, OPTIONS, 0, together=False)
    assert [camera.name for camera in cameras] == ["two", "a", "b"]


def test_every_photo_has_one_camera_and_every_camera_one_name(shots):
    made = shots(8, 5, focal=[1000.0] * 4 + [1500.0] * 4)
    found = cameras_of(made.as_set(["one"] * 7 + ["one #2"]))
    assert sorted(photo for camera in found for photo in camera.photos) == list(range(8))
    assert sorted(camera.name for camera in found) == ["one", "one #2", "one #3"]


def test_a_group_that_the_user_made_is_not_split(shots):
    pairs = shots(8, 1, focal=[1000.0] * 4 + [1500.0] * 4, points=250).as_set(["one"] * 8)
    for split, counts in ((True, [4, 4]), (False, [8])):
        cameras = calibrate_photo_set(pairs, calibrate, OPTIONS, 0, together=True, split=split)
        assert [len(camera.photos) for camera in cameras] == counts


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("error", [np.linalg.LinAlgError("Singular matrix"), ZeroDivisionError("division by zero")])
def test_a_calibrator_whose_numbers_fail_leaves_a_guess_with_the_reason(shots, together, error):
    def failing(*_):
        raise error

    cameras = calibrate_photo_set(shots(4, 1).as_set(["one"] * 4), failing, OPTIONS, 0, together=together)
    assert all(not camera.found.identifiable and camera.found.method == "guess" for camera in cameras)
    assert str(error) in cameras[0].found.reason


def test_cameras_keep_their_own_calibration_if_the_joint_one_fails(shots, monkeypatch):
    def failing(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(photo_set, "calibrate_cameras", failing)
    made = shots(6, 1).as_set(["one"] * 5 + ["two"])
    found = {camera.name: camera.found for camera in cameras_of(made)}
    assert found["one"].identifiable and found["one"].K[0, 0] == pytest.approx(1000, rel=0.03)
    assert not found["two"].identifiable and found["two"].method == "guess"


def test_photos_that_no_pair_gives_to_one_of_two_cameras_are_not_known(shots):
    pairs = of_two(shots).as_set(["one"] * 8)
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


def test_photos_of_another_camera_without_a_pair_of_their_own_are_found(shots):
    pairs = shots(8, 2, focal=[1000.0] * 6 + [1500.0] * 2).as_set(["one"] * 8)
    kept = [k for k, pair in enumerate(pairs.photos) if pair != (6, 7)]
    pairs = replace(
        pairs, Fs=pairs.Fs[kept], weights=pairs.weights[kept], photos=tuple(pairs.photos[k] for k in kept),
        inliers=tuple(pairs.inliers[k] for k in kept),
    )  # fmt: skip
    found = {camera.photos: camera.found for camera in cameras_of(pairs)}
    assert found[tuple(range(6))].identifiable
    assert found[6, 7].focal_px == pytest.approx(1500, rel=0.02)


def test_three_cameras_of_one_size_are_a_zoom_with_a_camera_for_each_photo(shots):
    focals = [800.0] * 4 + [1100.0] * 4 + [1500.0] * 4
    found = cameras_of(shots(12, 1, focal=focals, points=300).as_set(["zoom"] * 12))
    assert sorted(camera.photos for camera in found) == [(photo,) for photo in range(12)]
    off = [abs(camera.found.focal_px / focals[camera.photos[0]] - 1) for camera in found if camera.found.is_estimated]
    assert len(off) >= 10
    assert 0 < np.median(off) < 0.03


class FewerVotes(photo_set.VoteTables):
    """Tables without the first pair, as where its F repeats another's once its lens is taken out: copies of photos."""

    def __init__(self, Fs, members, weights):
        super().__init__(Fs, members, weights)
        self.indices, self.packed_rows, self.members, self.weights = (
            values[1:] for values in (self.indices, self.packed_rows, self.members, self.weights)
        )


def test_pairs_that_repeat_others_do_not_keep_two_cameras_together(shots, monkeypatch):
    monkeypatch.setattr(photo_set, "VoteTables", FewerVotes)
    found = cameras_of(of_two(shots).as_set(["zoom"] * 8))
    assert sorted(camera.photos for camera in found) == [(0, 1, 2, 3), (4, 5, 6, 7)]


def test_a_folder_of_unlike_cameras_gets_one_for_each_photo(shots):
    made = shots(10, 321, focal=UNLIKE, noise_px=0.5, points=300)
    found = cameras_of(made.as_set(["web"] * 10))
    assert sorted(camera.photos for camera in found) == [(photo,) for photo in range(10)]
    assert len({camera.name for camera in found}) == 10 and "web" in {camera.name for camera in found}
    off = {camera.photos[0]: np.log(camera.found.focal_px / UNLIKE[camera.photos[0]]) for camera in found}
    known = [off[camera.photos[0]] for camera in found if camera.found.identifiable]
    assert 5 <= len(known) <= 10 and sum(camera.found.is_estimated for camera in found) >= 7
    assert 0 < np.median(np.abs(known)) < 0.02
    assert max(map(abs, known)) < 0.1


def test_a_size_with_wrong_pairs_is_divided_where_the_other_sizes_are(shots):
    made, rng = shots(18, 4, focal=[*UNLIKE[::2], 1100.0] * 3, points=120), np.random.default_rng(0)
    pairs = made.as_set(["a"] * 6 + ["b"] * 6 + ["c"] * 6)
    Fs = np.array(pairs.Fs)
    wrong = [k for k, pair in enumerate(pairs.photos) if min(pair) >= 12 and rng.random() < 0.7]
    K = np.array([[1e3, 0, 500], [0, 1e3, 375], [0, 0, 1]])
    for k in wrong:
        change = K @ np.diag([1.0, 1.0, np.exp(rng.uniform(-1, 1))]) @ np.linalg.inv(K)
        Fs[k] = change.T @ Fs[k] @ change
    mixed = cameras_of(replace(pairs, Fs=Fs))
    assert sorted(len(one.photos) for one in mixed) == [1] * 18


def test_a_photo_without_pairs_follows_the_others(shots):
    focals = 2.0 * UNLIKE
    made = shots(10, 322, focal=focals, noise_px=0.5, points=300)
    pairs = made.as_set(["web"] * 10)
    pairs = replace(pairs, sizes={**pairs.sizes, 10: (1000, 750)}, groups={**pairs.groups, 10: "web"})
    found = cameras_of(pairs)
    (lonely,) = (camera for camera in found if camera.photos == (10,))
    assert not lonely.found.identifiable and "0 usable pairs" in lonely.found.reason
    assert 1700 < lonely.found.focal_px < 2800  # the others' mean is 2200, the usual focal 1200


def within_bars(made, groups):
    """Pictures of several shapes that bars have brought to one size."""
    pairs = made.as_set(groups)
    return replace(pairs, padded_sizes=dict.fromkeys(pairs.sizes, (1000, 1000)))


def test_pictures_of_one_shape_are_of_no_camera_where_all_others_are_of_their_own(shots):
    sizes = [(1000, 666)] * 4 + [(1000, 500 + 40 * k) for k in range(6)]
    focals = np.random.default_rng(2).permutation(UNLIKE)
    made = shots(10, 323, focal=focals, size=sizes, noise_px=0.5, points=300)
    pairs = within_bars(made, [f"{width}x{height}" for width, height in sizes])
    found = cameras_of(pairs)
    assert sorted(camera.photos for camera in found) == [(photo,) for photo in range(10)]
    off = [abs(np.log(camera.found.focal_px / focals[camera.photos[0]])) for camera in found]
    assert 0 < np.median(off) < 0.05


def test_two_cameras_within_bars_are_two(shots):
    sizes = [(1000, 750)] * 6 + [(1000, 600)] * 6
    made = shots(12, 324, focal=[900.0] * 6 + [1300.0] * 6, size=sizes, noise_px=0.5, points=300)
    pairs = within_bars(made, ["one"] * 6 + ["two"] * 6)
    found = cameras_of(pairs)
    assert [camera.photos for camera in found] == [tuple(range(6)), tuple(range(6, 12))]


def test_pairs_move_with_the_corners_that_pixels_are_counted_from(shots):
    pairs = shots(4, 1).as_set(["one"] * 4)
    corners = {1: (30, 0), 3: (-12, 7)}
    moved = pairs.with_origins(corners)
    for k, (first, second) in enumerate(pairs.photos):
        shift = np.array([*corners.get(first, (0, 0)), *corners.get(second, (0, 0))])
        assert moved.inliers[k] + shift == pytest.approx(pairs.inliers[k])
        before, after = (
            _residuals(F, x) for F, x in ((pairs.Fs[k], pairs.inliers[k]), (moved.Fs[k], moved.inliers[k]))
        )
        assert after == pytest.approx(before, abs=1e-9)
    assert pairs.with_origins({}) is pairs


def _residuals(F, x):
    ones = np.ones((len(x), 1))
    return np.einsum("ni,ij,nj->n", np.hstack([x[:, 2:], ones]), F, np.hstack([x[:, :2], ones]))
