import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.errors import ReconstructionError
from sfm_app.estimation.diagnosis import HINTS, NOTHING_MATCHED, diagnose_depth, diagnose_scene
from sfm_app.fundamental.degeneracy import ONLY_A_LOGO, SAME_PHOTO
from sfm_app.geometry.epipolar import eight_point
from sfm_app.settings import EpipolarSettings, MatchSettings
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.types import EpipolarFit, MatchedImage, MatchGraph, Rejected, ViewGraph

SIZE = (640, 480)


def photos(features=(1500,)):
    """So many photos without matches."""
    images = {key: MatchedImage(key, f"{key}.jpg", "one", *SIZE) for key in range(1, len(features) + 1)}
    return MatchGraph(images, {key: np.zeros((count, 2)) for key, count in enumerate(features, start=1)}, {})


def fit(inliers, degeneracy=""):
    return EpipolarFit(np.eye(3), np.ones(inliers, bool), np.ones(inliers), 10, 0.3, degeneracy)


def rejected(*reasons):
    """Pairs (1, 2), (1, 3), ... by what was wrong with them."""
    return ViewGraph({}, {(1, key): Rejected(reason) for key, reason in enumerate(reasons, start=2)})


def turned(moved, kinds, photos=4, noise=0.4):
    """Views of one scene, each turned and moved from the last; what the pairs are taken for is given."""
    rng = np.random.default_rng(2)
    X = rng.uniform([-4, -1.5, 5], [4, 1.5, 9], (300, 3))
    K = camera_matrix(600.0, 600.0, 330.0, 235.0)
    images = {key: MatchedImage(key, f"{key}.jpg", "one", *SIZE) for key in range(1, photos + 1)}
    keypoints = {}
    for key in images:
        seen = (X - np.multiply(key, moved)) @ axis_rotation(np.array([0.0, 1.0, 0.0]), 6.0 * key - 15.0).T @ K.T
        keypoints[key] = seen[:, :2] / seen[:, 2:] + rng.normal(scale=noise, size=(300, 2))
    pairs = [(a, b) for a in images for b in images if a < b]
    rows = np.tile(np.arange(300, dtype=np.uint32)[:, None], 2)
    Fs = [eight_point(*(keypoints[key] for key in pair)) for pair in pairs]
    everything = np.ones(300, bool)
    fits = {
        pair: EpipolarFit(F, everything, everything * 1.0, 10, 0.3, kind)
        for pair, F, kind in zip(pairs, Fs, kinds, strict=True)
    }
    return MatchGraph(images, keypoints, dict.fromkeys(pairs, rows)), ViewGraph(fits, {})


@pytest.mark.parametrize(
    ("matches", "views", "cause", "says"),
    [
        (photos((1500, 2000)), NOTHING_MATCHED, "nothing", "the 2 photos show nothing in common (1500 to 2000 feat"),
        (photos((1500,) * 3), rejected("too few matches", "no model found"), "nothing", "1 pairs: too few matches"),
        (photos((0,) * 10), NOTHING_MATCHED, "texture", "hardly any texture: no features"),
        (photos((90, 200, 300)), rejected("too few matches", "too few matches"), "texture", "90 to 300 features"),
        (photos((20, 2000, 2100)), NOTHING_MATCHED, "nothing", "nothing in common"),  # one bare photo among others
        (photos((900,) * 3), rejected(SAME_PHOTO, SAME_PHOTO), "copies", "3 copies of one photo"),
        (photos((10,) * 3), rejected(SAME_PHOTO, SAME_PHOTO), "copies", "3 copies of one photo"),
        (photos((900,) * 3), rejected(SAME_PHOTO, "too few inliers"), "nothing", "1 pairs: the same photo twice"),
        (photos((900,) * 3), rejected(ONLY_A_LOGO, ONLY_A_LOGO), "logo", "nothing in common but a logo"),
        (photos((900,) * 4), rejected(ONLY_A_LOGO, *["too few inliers"] * 2), "nothing", "2 pairs: too few inliers"),
    ],
)
def test_photos_that_no_pair_connects(matches, views, cause, says):
    found = diagnose_scene(matches, views, MatchSettings())
    assert (found.cause, says in found.message) == (cause, True)


def test_features_are_counted_in_the_photo_as_it_was_searched():
    large = MatchGraph({1: MatchedImage(1, "1.jpg", "one", 6400, 4800)}, {1: np.zeros((3000, 2))}, {})
    assert diagnose_scene(large, NOTHING_MATCHED, MatchSettings()).cause != "texture"
    assert diagnose_scene(large, NOTHING_MATCHED, MatchSettings(max_image_size_px=6400)).cause == "texture"


@pytest.mark.parametrize(
    ("kinds", "cause", "says"),
    [
        ({"rotation": 900, "planar": 100, "": 60}, "rotation", "the camera only turned: photos from one spot hold no"),
        ({"planar": 900, "rotation": 100}, "planar", "everything lies in one plane (1 of 2 pairs)"),
        ({"collinear": 500, "": 100}, "collinear", "lies on one line"),
        ({"": 600, "planar": 500}, "unclear", "2 pairs with 500 to 600 inliers, 1 rejected: too few inliers"),
    ],
)
def test_pairs_vote_with_their_inliers(kinds, cause, says):
    fits = {(1, key): fit(count, kind) for key, (kind, count) in enumerate(kinds.items(), start=2)}
    views = ViewGraph(fits, {(2, 3): Rejected("too few inliers")})
    found = diagnose_scene(photos((900,) * 5), views, MatchSettings())
    assert (found.cause, says in found.message) == (cause, True)


MOSTLY_TURNED = ["rotation", "planar", "rotation", "", "rotation", ""]


def test_a_panorama_is_one_although_pairs_are_misjudged():
    matches, views = turned((0.0, 0.0, 0.0), MOSTLY_TURNED)
    assert diagnose_scene(matches, views, MatchSettings()).cause == "rotation"
    assert diagnose_depth(matches, views, [1, 2, 3, 4], EpipolarSettings(), camera_known=True).cause == "rotation"


@pytest.mark.parametrize("moved", [(0.2, 0.0, 0.0), (0.4, 0.0, 0.0)])
def test_a_few_pairs_with_parallax_hold_depth_whatever_the_others_say(moved):
    matches, views = turned(moved, MOSTLY_TURNED)
    assert diagnose_depth(matches, views, [1, 2, 3, 4], EpipolarSettings(), camera_known=False) is None


@pytest.mark.parametrize(
    ("kind", "count", "camera_known", "cause"),
    [
        ("planar", 2, False, "planar"),
        ("planar", 2, True, None),
        ("planar", 3, False, None),
        ("collinear", 4, True, "collinear"),
        ("", 2, False, None),
    ],
)
def test_a_model_needs_depth_or_a_plane_and_its_camera(kind, count, camera_known, cause):
    matches, views = turned((0.4, 0.0, 0.0), [kind] * 6)
    found = diagnose_depth(matches, views, range(1, count + 1), EpipolarSettings(), camera_known=camera_known)
    assert (found.cause if found else None) == cause


def test_a_model_that_no_pair_supports_is_not_judged():
    assert diagnose_depth(photos((900,) * 3), NOTHING_MATCHED, [1, 2], EpipolarSettings(), camera_known=False) is None


def test_a_diagnosis_ends_the_run_with_exit_code_4():
    error = diagnose_scene(photos((0, 0)), NOTHING_MATCHED, MatchSettings()).error("two seeds tried")
    assert isinstance(error, ReconstructionError) and error.exit_code == 4
    assert str(error).endswith("; two seeds tried") and error.hint == HINTS["texture"]
