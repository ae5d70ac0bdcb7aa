from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.settings import Settings
from sfm_app.stages import scene
from sfm_app.types import EpipolarFit, MatchedImage, MatchGraph, Rejected, ViewGraph


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


def test_a_failure_says_what_was_seen():
    views = ViewGraph({(1, 2): fit(40), (1, 3): fit(17, "planar")}, {(2, 3): Rejected("too few inliers")})

    text = scene.nothing_found(views, [], ["1.jpg + 2.jpg: 0 photos"])

    for part in (
        "2 pairs with 17 to 40 inliers",
        "1 of them planar",
        "1 pairs rejected: too few inliers",
        "no pair has parallax",
    ):
        assert part in text
