from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.geometry.camera import camera_matrix
from sfm_app.geometry.epipolar import eight_point
from sfm_app.settings import Settings
from sfm_app.stages import scene
from sfm_app.types import Calibration, EpipolarFit, Intrinsics, MatchedImage, MatchGraph, Rejected, ViewGraph

K = camera_matrix(800.0, 800.0, 320.0, 240.0)


def two_views(radial=0.0, pairs=((1, 2), (1, 3)), group="one"):
    """Photos that look at the same points from places a step apart, through a lens, with their noisy F's."""
    rng = np.random.default_rng(4)
    X = rng.uniform([-2, -1.5, 5], [2, 1.5, 8], (120, 3))
    keypoints, fits = {}, {}
    for key in {key for pair in pairs for key in pair}:
        x = (X - [0.8 * (key - 1), 0, 0])[:, :2] / X[:, 2:]
        keypoints[key] = (x * (1 + radial * (x**2).sum(1, keepdims=True))) * 800 + [320, 240]
        keypoints[key] += rng.normal(scale=0.2, size=x.shape)
    rows = np.tile(np.arange(120, dtype=np.uint32)[:, None], 2)
    for pair in pairs:
        F = eight_point(keypoints[pair[0]], keypoints[pair[1]])
        fits[pair] = EpipolarFit(F, np.ones(120, bool), np.ones(120), 10, 0.3)
    images = {key: MatchedImage(key, f"{key}.jpg", group, 640, 480) for key in keypoints}
    return MatchGraph(images, keypoints, dict.fromkeys(pairs, rows)), ViewGraph(fits, {})


def ranked(matches, views, intrinsics):
    run = SimpleNamespace(settings=Settings(), map=lambda function, items, _: [function(item) for item in items])
    return scene.rank_seeds(matches, views, intrinsics, run)


def known(radial=0.0, key_pairs=()):
    return Calibration(K, 640, 480, "zero-curves", True, radial=radial, key_pairs=key_pairs)


def test_a_seed_is_made_from_what_the_photos_show_without_their_lens():
    matches, views = two_views(radial=-0.25)

    straight = ranked(matches, views, Intrinsics({"one": known(-0.25)}))[0].seed
    bent = ranked(matches, views, Intrinsics({"one": known()}))[0].seed

    off = [np.degrees(np.arccos(min(1, (np.trace(seed.R) - 1) / 2))) for seed in (straight, bent)]
    assert off[0] < 0.3 < 1.0 < off[1]
    assert abs(straight.t @ [-1, 0, 0]) > 0.9999
    assert np.median(straight.points[:, 2]) * 1.6 == pytest.approx(6.5, abs=0.5)


def test_pairs_that_agree_with_the_camera_start_before_pairs_that_do_not():
    matches, views = two_views()

    by_score = ranked(matches, views, Intrinsics({"one": known()}))
    agreeing = ranked(matches, views, Intrinsics({"one": known(key_pairs=((1, 2),))}))

    assert [candidate.pair for candidate in by_score] == [(1, 3), (1, 2)]  # the wider angle
    assert [candidate.pair for candidate in agreeing] == [(1, 2), (1, 3)]


def test_cameras_are_those_that_took_the_photos_not_those_of_their_group():
    matches, views = two_views(pairs=((1, 2),))
    other = Calibration(np.diag([2.0, 2.0, 1.0]) @ K, 640, 480, "zero-curves", True)
    apart = Intrinsics({"one": other, "one #2": known()}, {"1.jpg": "one #2", "2.jpg": "one #2"})

    assert np.array_equal(
        ranked(matches, views, apart)[0].seed.points,
        ranked(matches, views, Intrinsics({"one": known()}))[0].seed.points,
    )


def fit(inliers, degeneracy=""):
    return EpipolarFit(np.eye(3), np.arange(50) < inliers, np.ones(50), 10, 0.3, degeneracy)


def graph(photos):
    images = {key: MatchedImage(key, f"{key}.jpg", "one", 100, 100) for key in range(1, photos + 1)}
    return MatchGraph(images, {}, {})


def model(photos):
    images = {key: SimpleNamespace(image_id=key, has_pose=True) for key in range(1, photos + 1)}
    return SimpleNamespace(images=images, num_reg_images=lambda: photos)


def try_seeds(monkeypatch, outcomes, photos=10, seed_pairs=5):
    """What `best_model` makes of seeds that grow into models of so many photos."""
    views = ViewGraph({(key, key + 1): fit(40) for key in range(1, photos)}, {})
    candidates = [SimpleNamespace(pair=(key, key + 1)) for key in range(1, len(outcomes) + 1)]
    grown = iter(outcomes)
    monkeypatch.setattr(scene, "grow", lambda *_: model(count) if (count := next(grown)) else None)
    run = SimpleNamespace(settings=Settings.from_mapping({"scene": {"seed_pairs": seed_pairs}}))
    best, tried = scene.best_model(candidates, graph(photos), views, run)
    return best.num_reg_images() if best else None, len(tried)


@pytest.mark.parametrize(
    ("outcomes", "photos", "tries"),
    [
        ((10, 3), 10, 1),  # all photos: nothing better can come
        ((0, 0, 9), 9, 3),  # seeds that fail are followed by the next best
        ((3, 3, 7, 2, 2), 7, 5),  # few photos, twice the same, are no reason to stop
        ((6, 6, 9), 6, 2),  # more than half, twice the same: the others hang loose
        ((0, 0, 0, 0, 0, 10), None, 5),  # no more tries than allowed
    ],
)
def test_seeds_are_tried_until_one_grows(monkeypatch, outcomes, photos, tries):
    assert try_seeds(monkeypatch, outcomes) == (photos, tries)


def test_photos_of_a_second_place_do_not_count_against_a_seed():
    views = ViewGraph({(1, 2): fit(40), (2, 3): fit(40), (7, 8): fit(40)}, {(3, 7): Rejected("too few inliers")})

    assert scene.connected((1, 2), views) == {1, 2, 3}
    assert scene.connected((7, 8), views) == {7, 8}


def test_every_photo_without_a_place_has_a_reason():
    views = ViewGraph({(1, 2): fit(40), (1, 3): fit(17), (2, 3): fit(20), (4, 5): fit(30)}, {})

    reasons = scene.left_out(model(2), graph(6), views)

    assert reasons == {
        "3.jpg": "could not be placed: at most 20 inliers with a photo that was",
        "4.jpg": "shares inliers only with photos that have no place either",
        "5.jpg": "shares inliers only with photos that have no place either",
        "6.jpg": "shares no scene with any other photo",
    }
