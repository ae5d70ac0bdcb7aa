"""A part whose model has two places in one; mappers and judges are stand-ins."""

import pytest

from sfm_app.colmap.types import Reconstruction
from sfm_app.reconstruction.mapping_runs import Attempt, Group, NoModel
from sfm_app.reconstruction.parts import hide_false_joins, unfolding
from sfm_app.reconstruction.parts.part_files import joins_from_plain, joins_to_plain
from sfm_app.reconstruction.parts.parts_run import merge_false_joins
from sfm_app.reconstruction.parts.unfolding import map_unfolded
from sfm_app.types import Intrinsics, LookAlikes, MatchGraph, PoseGraph, ViewGraph

JOIN = LookAlikes(((3, 8), (4, 9)), 0.9)


class _Model(Reconstruction):
    def __init__(self, photos):
        super().__init__()
        self.count = len(photos)

    def num_reg_images(self):
        return self.count


def part(pairs):
    photos = sorted({photo for pair in pairs for photo in pair})
    fits = dict.fromkeys(pairs, "fit")
    rows = {pair: [1, 2] for pair in pairs}
    graph = PoseGraph(dict.fromkeys(pairs, "pose"), {}, (tuple(photos),))
    return Group(tuple(photos), MatchGraph({}, {}, rows), ViewGraph(fits, {}), graph, Intrinsics({}))


STREETS = [(k, k + 1) for k in (1, 2, 3, 4, 6, 7, 8, 9, 10)]
"""Photos 1 to 5 and 6 to 11; what connects them is the false join, or also a corner."""
FOLDED = part([*STREETS, *JOIN.pairs])
WITH_CORNER = part([*STREETS, *JOIN.pairs, (5, 6)])


@pytest.fixture
def mapped(monkeypatch):
    """Maps every piece, from the second on without some photos; places are judged so, one after the other.

    Gives the photos that were mapped.
    """

    def start(*judgments, lost=()):
        seen, left = [], list(judgments)

        def map_group(group, _):
            seen.append(tuple(group.photos))
            photos = [photo for photo in group.photos if len(seen) == 1 or photo not in lost]
            return [
                Attempt("incremental", _Model(photos), {}, f"{len(photos)} photos"),
                NoModel("global", "not needed"),
            ]

        monkeypatch.setattr(unfolding, "map_group", map_group)
        monkeypatch.setattr(unfolding, "judge_places", lambda _: left.pop(0))
        return seen

    return start


def test_a_part_of_one_place_is_mapped_once(mapped):
    seen, followed = mapped(([], 0)), []

    found = map_unfolded(FOLDED, followed.append, None)

    assert seen == [tuple(range(1, 12))] and followed == []
    assert found.photos == 11 and found.false_joins == () and found.tried == ("11 photos", "not needed")


def test_both_sides_of_a_false_join_become_models_of_their_own(mapped):
    seen, followed = mapped(([JOIN], 20), ([], 0)), []

    found = map_unfolded(FOLDED, followed.append, None)

    assert seen[1:] == [(6, 7, 8, 9, 10, 11), (1, 2, 3, 4, 5)]
    assert [model.photos for model in found.models] == [6, 5]
    assert found.false_joins == (JOIN,)
    (rival,) = followed
    for known in (rival.graph.poses, rival.matches.matches, rival.views.fits):
        assert set(known) == set(STREETS)


def test_sides_that_a_corner_connects_stay_one_model(mapped):
    seen = mapped(([JOIN], 20), ([], 0))

    found = map_unfolded(WITH_CORNER, lambda _: None, None)

    assert seen[1:] == [tuple(range(1, 12))]
    assert found.photos == 11 and found.false_joins == (JOIN,)


@pytest.mark.parametrize(("strangers", "lost"), [(15, ()), (0, (1, 2))])
def test_a_rival_that_is_no_better_leaves_the_join_to_the_whole(mapped, strangers, lost):
    mapped(([JOIN], 20), ([], strangers), lost=lost)

    found = map_unfolded(FOLDED, lambda _: None, None)

    assert found.false_joins == () and found.photos == 11
    assert len(found.tried) == 6  # two notes on the part, and on each side


def test_false_joins_are_sought_three_times(mapped):
    others = [LookAlikes((pair,), 0.8) for pair in ((1, 2), (2, 3), (6, 7), (7, 8))]
    seen = mapped(*(([join], count) for join, count in zip(others, (80, 40, 20, 10), strict=True)))

    found = map_unfolded(WITH_CORNER, lambda _: None, None)

    assert found.false_joins == tuple(others[:3]) and len(found.tried) >= 4 and len(seen) >= 4


def test_a_group_without_false_joins_keeps_all():
    hidden = hide_false_joins(FOLDED, [])

    assert hidden.matches is FOLDED.matches and set(hidden.graph.poses) == set(FOLDED.graph.poses)


def test_a_join_that_two_parts_share_counts_once():
    again = LookAlikes(((4, 9), (5, 10)), 0.7)

    assert merge_false_joins([JOIN, again, JOIN]) == (JOIN, LookAlikes(((5, 10),), 0.7))
    assert merge_false_joins([]) == ()


def test_joins_travel_as_plain_values():
    assert joins_from_plain(joins_to_plain([JOIN])) == (JOIN,)
