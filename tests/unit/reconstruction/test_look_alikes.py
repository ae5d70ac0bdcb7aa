from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.mapping.look_alikes import drop_look_alikes, jumps, look_alike_entries, sides, with_earlier_look_alikes
from sfm_app.types import EpipolarFit, LookAlikes, MatchedImage, MatchGraph, PoseGraph, ViewGraph

COUNTS = {(1, 2): 90, (1, 11): 80, (2, 12): 70, (2, 11): 20, (11, 12): 90}
JOIN = LookAlikes(((1, 11), (2, 11), (2, 12)), 0.3456)


@pytest.fixture
def matches():
    photos = {photo for pair in COUNTS for photo in pair}
    return MatchGraph(
        {photo: MatchedImage(photo, f"{photo}.jpg", "camera", 100, 80) for photo in photos},
        {photo: np.zeros((90, 2)) for photo in photos},
        {pair: np.zeros((count, 2), np.uint32) for pair, count in COUNTS.items()},
    )


def graph(*joins, dropped=None):
    return PoseGraph({}, dropped or {}, (), joins)


def test_matches_of_look_alikes_do_not_speak(matches):
    fit = EpipolarFit(np.eye(3), np.ones(1, bool), np.ones(1), 1, 0.1)
    views = ViewGraph({(1, 2): fit, (1, 11): fit}, {})

    kept, seen = drop_look_alikes(matches, views, graph(JOIN))

    assert set(kept.matches) == {(1, 2), (11, 12)} and set(seen.fits) == {(1, 2)}
    assert drop_look_alikes(matches, views, graph()) == (matches, views)


def test_a_second_pass_knows_what_the_first_told_apart():
    later = LookAlikes(((3, 4),), 0.5)
    first = graph(JOIN, dropped=dict.fromkeys(JOIN.pairs, "alike") | {(7, 8): "else"})

    found = with_earlier_look_alikes(graph(later, dropped={(3, 4): "alike"}), first)

    assert found.look_alikes == (JOIN, later)
    assert found.dropped == dict.fromkeys((*JOIN.pairs, (3, 4)), "alike")


def test_the_photos_of_a_join_fall_into_two_places(matches):
    assert sides(JOIN.pairs, matches) == ([1, 2], [11, 12])
    assert look_alike_entries([JOIN], matches) == [
        {"pairs": 3, "between": [["1.jpg", "2.jpg"], ["11.jpg", "12.jpg"]], "missing": 0.346}
    ]


def model(places):
    def image(number, x):
        return SimpleNamespace(
            image_id=number, name=f"{number:02d}.jpg", has_pose=True, projection_center=lambda: np.array([x, 0.0, 0.0])
        )

    return SimpleNamespace(images={number: image(number, x) for number, x in enumerate(places)})


def test_a_walk_that_jumps_is_named_where_it_does():
    steady = np.arange(36) + np.tile([0.0, 0.1], 18)

    assert jumps(model(steady)) == []
    assert jumps(model([*steady[:7], *(steady[7:] + 12.0)])) == [["06.jpg", "07.jpg"]]
    assert jumps(model([*steady[:7], *(steady[7:] + 2.0)])) == []


def test_photos_in_no_order_do_not_jump():
    rng = np.random.default_rng(0)

    assert jumps(model(rng.permutation(40).astype(float))) == []
    assert jumps(model(np.where(np.arange(40) % 4 == 3, 100.0, 0.0) + np.arange(40))) == []
    assert jumps(model([*range(14), *range(50, 64)])) == [], "too few"
