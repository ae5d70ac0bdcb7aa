import numpy as np

from sfm_app.mapping.attempt import photo_names, unregistered_reasons
from sfm_app.posegraph.graph import BEHIND, CONTRADICTS, TOO_FEW
from sfm_app.types import EpipolarFit, MatchedImage, MatchGraph, PoseGraph, RelativePose, ViewGraph


def fit(inliers, degeneracy=""):
    return EpipolarFit(np.eye(3), np.arange(50) < inliers, np.ones(50), 10, 0.3, degeneracy)


def pose(kind="calibrated"):
    return RelativePose(np.eye(3), np.eye(3)[0], np.ones(50, bool), 10.0, 1.0, kind)


def photos(count, blank=()):
    images = {key: MatchedImage(key, f"{key}.jpg", "one", 100, 100) for key in range(1, count + 1)}
    return MatchGraph(images, {key: np.ones((0 if key in blank else 9, 2)) for key in images}, {})


def test_a_photo_without_features_says_so():
    reasons = unregistered_reasons({1, 2}, [], photos(4, blank=(4,)), ViewGraph({(1, 2): fit(40)}, {}), pose_graph())

    assert reasons == {"3.jpg": "shares no scene with any other photo", "4.jpg": "no features were found in it"}


def pose_graph(dropped=None, poses=None):
    return PoseGraph(poses or {}, dropped or {}, ())


def test_every_photo_without_a_place_has_a_reason():
    views = ViewGraph({(1, 2): fit(40), (1, 3): fit(17), (2, 3): fit(20), (4, 5): fit(30), (2, 7): fit(25)}, {})

    reasons = unregistered_reasons({1, 2}, [(7, 8, 9)], photos(9), views, pose_graph())

    assert reasons == {
        "3.jpg": "could not be placed: 20 inliers with the nearest placed photo",
        "4.jpg": "shares inliers only with photos that have no place either",
        "5.jpg": "shares inliers only with photos that have no place either",
        "6.jpg": "shares no scene with any other photo",
        "7.jpg": "belongs to another model, of 3 photos",
        "8.jpg": "belongs to another model, of 3 photos",
        "9.jpg": "belongs to another model, of 3 photos",
    }


def test_a_photo_whose_nearest_pair_was_dropped_says_why():
    views = ViewGraph({(1, 2): fit(40), (1, 3): fit(17), (2, 3): fit(20), (2, 4): fit(30), (1, 5): fit(18)}, {})
    dropped = {(1, 3): BEHIND, (2, 3): CONTRADICTS, (1, 5): TOO_FEW}

    reasons = unregistered_reasons({1, 2}, [], photos(5), views, pose_graph(dropped))
    near = "inliers with the nearest placed photo"

    assert reasons == {
        "3.jpg": f"could not be placed: 20 {near}, but that pair was dropped: {CONTRADICTS}",
        "4.jpg": f"could not be placed: 30 {near}",
        "5.jpg": f"could not be placed: 18 {near}, but that pair was dropped: {TOO_FEW}",
    }


def test_of_photos_equally_near_the_first_is_the_nearest():
    views = ViewGraph({(1, 3): fit(20), (2, 3): fit(20)}, {})

    assert (
        CONTRADICTS
        not in unregistered_reasons({1, 2}, [], photos(3), views, pose_graph({(2, 3): CONTRADICTS}))["3.jpg"]
    )
    assert CONTRADICTS in unregistered_reasons({1, 2}, [], photos(3), views, pose_graph({(1, 3): CONTRADICTS}))["3.jpg"]


def test_when_all_photos_have_a_place_none_has_a_reason():
    assert unregistered_reasons({1, 2}, [], photos(2), ViewGraph({(1, 2): fit(40)}, {}), pose_graph()) == {}


def test_names_come_in_the_order_of_the_photos_given():
    assert photo_names((3, 1), photos(3)) == ["3.jpg", "1.jpg"]
