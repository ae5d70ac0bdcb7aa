"""What calibrators get to know about a set of photos."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.estimation.calibrating import photo_pairs, to_whole_photo
from sfm_app.selfcal import CalibratedCamera, pair_weights
from sfm_app.selfcal.pairs import guess_calibration
from sfm_app.types import CameraPrior, EpipolarFit, MatchedImage, MatchGraph, Rejected, ViewGraph
from sfm_app.types.photos import EXIF


def fit(inliers, degeneracy=""):
    rng = np.random.default_rng(len(inliers))
    return EpipolarFit(rng.normal(size=(3, 3)), np.array(inliers), np.ones(len(inliers)), 9, 0.5, degeneracy)


IMAGES = {
    7: MatchedImage(7, "a.jpg", "big", 1000, 750, CameraPrior(EXIF, 900.0, 36.0)),
    2: MatchedImage(2, "b.jpg", "big", 1000, 750, None),
    3: MatchedImage(3, "c.jpg", "small", 640, 480),
    9: MatchedImage(9, "d.jpg", "small", 640, 480, CameraPrior("a net", 600.0, 50.0, (320.0, 250.0), 9.0)),
}
POINTS = {key: np.random.default_rng(key).uniform(0, 480, (5, 2)) for key in IMAGES}
ROWS = {pair: np.array([[0, 1], [2, 2], [4, 0]], np.uint32) for pair in [(2, 7), (2, 3), (3, 9), (7, 9), (3, 7)]}
MATCHES = MatchGraph(IMAGES, POINTS, ROWS)
VIEWS = ViewGraph(
    {
        (2, 7): fit([True, False, True]),
        (2, 3): fit([True, True, True]),
        (3, 9): fit([True] * 3, "planar"),
        (7, 9): fit([False] * 3),
    },
    {(3, 7): Rejected("too few")},
)


def test_pairs_that_show_a_camera_are_all_there():
    pairs = photo_pairs(list(IMAGES.values()), MATCHES, VIEWS)
    assert pairs.photos == ((2, 7), (2, 3), (7, 9))
    np.testing.assert_array_equal(pairs.Fs, [VIEWS.fits[pair].F for pair in pairs.photos])
    np.testing.assert_array_equal(pairs.weights, pair_weights([2, 3, 0]))
    assert [len(x) for x in pairs.inliers] == [2, 3, 0]
    np.testing.assert_array_equal(pairs.inliers[0], np.hstack([POINTS[2][[0, 4]], POINTS[7][[1, 0]]]))
    assert pairs.sizes == {7: (1000, 750), 2: (1000, 750), 3: (640, 480), 9: (640, 480)}
    assert pairs.groups == {7: "big", 2: "big", 3: "small", 9: "small"}
    assert {photo: prior.focal_px for photo, prior in pairs.priors.items()} == {7: 900.0, 9: 600.0}


def test_a_camera_gets_its_own():
    own = photo_pairs([IMAGES[7], IMAGES[2]], MATCHES, VIEWS).to_camera_pairs([7, 2])
    assert (own.photos, own.size, own.prior.focal_px) == (((2, 7),), (1000, 750), 900.0)
    assert own.Fs.shape == (1, 3, 3)
    assert len(own.inliers) == 1


@pytest.mark.parametrize("chosen", [[3], [3, 9]])
def test_without_pairs_the_arrays_are_empty_and_the_claims_remain(chosen):
    own = photo_pairs([IMAGES[key] for key in chosen], MATCHES, VIEWS).to_camera_pairs(chosen)
    assert (own.Fs.shape, own.weights.shape, own.photos, own.inliers) == ((0, 3, 3), (0,), (), ())
    assert own.size == (640, 480)
    assert own.prior == (IMAGES[9].prior if 9 in chosen else None)


def test_pixels_are_counted_within_bars_and_the_camera_is_that_of_the_whole_photo():
    image = replace(IMAGES[7], shown=(0, 100, 800, 600))
    images = {**IMAGES, 7: image}
    pairs = photo_pairs(list(images.values()), replace(MATCHES, images=images), VIEWS)
    plain = photo_pairs(list(IMAGES.values()), MATCHES, VIEWS)
    assert (pairs.sizes[7], pairs.padded_sizes) == ((800, 600), {7: (1000, 750)})
    assert pairs.priors[7].focal_px == pytest.approx(720)  # 900 px were reckoned with a width of 1000
    assert pairs.priors[7].focal_deviation_px == pytest.approx(28.8)
    shifted = photo_pairs([replace(IMAGES[9], shown=(10, 20, 600, 440))], MATCHES, VIEWS).priors[9]
    assert (shifted.focal_px, shifted.center_px) == (600.0, (310.0, 230.0))
    np.testing.assert_allclose(pairs.inliers[0], plain.inliers[0] - [0, 0, 0, 100])
    np.testing.assert_array_equal(pairs.inliers[1], plain.inliers[1])

    camera = to_whole_photo(CalibratedCamera("big", (7,), guess_calibration((800, 600), "", {})), image)

    assert (camera.found.width, camera.found.height) == (1000, 750)
    np.testing.assert_allclose(camera.found.K, [[960, 0, 400], [0, 960, 400], [0, 0, 1]])
    whole = CalibratedCamera("big", (2,), guess_calibration((1000, 750), "", {}))
    assert to_whole_photo(whole, IMAGES[2]) is whole
