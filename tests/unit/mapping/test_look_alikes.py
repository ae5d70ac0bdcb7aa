"""Look-alikes in models of photos that walk along walls, with real cameras of COLMAP."""

from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.mapping import passes
from sfm_app.mapping.attempt import Attempt, PairSupport
from sfm_app.mapping.look_alikes import (
    OVERLAPS,
    ExpectedOverlap,
    find_expected_overlaps,
    find_false_joins,
    find_non_overlapping,
    joined_pairs,
    judge_places,
    jumps,
    look_alike_entries,
    sides,
    with_earlier_look_alikes,
)
from sfm_app.mapping.passes import Outcome, without_misplaced
from sfm_app.settings import Settings
from sfm_app.types import EpipolarFit, Evidence, Intrinsics, LookAlikes, MatchedImage, MatchGraph, PoseGraph, ViewGraph

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
    evidence = Evidence(matches, views, Intrinsics({}))
    kept = evidence.without(joined_pairs(graph(JOIN).look_alikes))
    assert set(kept.matches.matches) == {(1, 2), (11, 12)} and set(kept.views.fits) == {(1, 2)}
    assert evidence.without(joined_pairs(graph().look_alikes)) is evidence


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


def model(places, name="{:d}.jpg".format):
    def image(number, x):
        return SimpleNamespace(
            image_id=number, name=name(number), has_pose=True, projection_center=lambda: np.array([x, 0.0, 0.0])
        )

    return SimpleNamespace(images={number: image(number, x) for number, x in enumerate(places)})


def test_a_walk_that_jumps_is_named_where_it_does():
    steady = np.arange(36) + np.tile([0.0, 0.1], 18)
    assert jumps(model(steady)) == []
    assert jumps(model([*steady[:7], *(steady[7:] + 12.0)])) == [["6.jpg", "7.jpg"]]
    assert jumps(model([*steady[:12], *(steady[12:] + 12.0)], "frame_{:03d}0.png".format)) == [
        ["frame_0110.png", "frame_0120.png"]
    ]
    assert jumps(model([*steady[:7], *(steady[7:] + 2.0)])) == []


@pytest.mark.parametrize(
    "name",
    [
        lambda number: f"DSC_{number + 80 * (number > 11):04d}.JPG",
        lambda number: f"{'court' if number > 11 else 'gate'}/{number:02d}.jpg",
        lambda number: f"{chr(ord('A') + number // 26)}{chr(ord('a') + number % 26)}.jpg",
    ],
    ids=["numbers far apart", "folders", "no numbers"],
)
def test_a_series_that_starts_elsewhere_is_no_jump(name):
    places = np.arange(36) + np.tile([0.0, 0.1], 18)
    assert jumps(model([*places[:12], *(places[12:] + 12.0)], name)) == []


def test_photos_in_no_order_do_not_jump():
    rng = np.random.default_rng(0)
    assert jumps(model(rng.permutation(40).astype(float))) == []
    assert jumps(model(np.where(np.arange(40) % 4 == 3, 100.0, 0.0) + np.arange(40))) == []
    assert jumps(model([*range(14), *range(50, 64)])) == [], "too few"


WIDTH, HEIGHT, FOCAL, AWAY = 600, 450, 500.0, 5.0


class Walls:
    """Photos at x, y = 0, z = 0 that look at walls at z = `AWAY`; every walk sees the points of its own."""

    def __init__(self):
        self.model = pycolmap.Reconstruction()
        self.tracks = {}
        self.points = np.empty((0, 3))

    def add_points(self, low, high, seed, per_meter=120, away=AWAY):
        """Add points of a wall, and return their numbers."""
        count = round(per_meter * (high - low))
        x, y = np.random.default_rng(seed).uniform([[low], [-2]], [[high], [2]], (2, count))
        self.points = np.vstack([self.points, np.column_stack([x, y, np.full(count, away)])])
        return np.arange(len(self.points) - count, len(self.points))

    def add_walk(self, photos, places, known, shift=0.0, zoom=1.0):
        """Add photos with these ids at these places, which see the points that are known to them."""
        camera, focal = min(photos), zoom * FOCAL
        self.model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT,
                            params=[focal, WIDTH / 2, HEIGHT / 2], camera_id=camera)
        )  # fmt: skip
        for photo, place in zip(photos, places, strict=True):
            seen = self.points[known] - [place, shift, 0.0]
            x = focal * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2]
            inside = ((x > 0) & (x < [WIDTH, HEIGHT])).all(axis=1)
            image = pycolmap.Image(image_id=photo, name=f"{photo:03d}.jpg", camera_id=camera)
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in x[inside]])
            self.model.add_image_with_trivial_frame(
                image, pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), -np.array([place, shift, 0.0]))
            )
            for row, number in enumerate(np.asarray(known)[inside]):
                self.tracks.setdefault(int(number), []).append((photo, row))

    def finish(self):
        """Return the model, and the matches that it explains."""
        common = {}
        for number, ends in sorted(self.tracks.items()):
            track = pycolmap.Track()
            for photo, row in ends:
                track.add_element(photo, row)
            self.model.add_point3D(self.points[number], track, np.zeros(3, np.uint8))
            for k, (photo, _) in enumerate(ends):
                for other, _ in ends[k + 1 :]:
                    pair = (min(photo, other), max(photo, other))
                    common[pair] = common.get(pair, 0) + 1
        return self.model, {pair: PairSupport(count, count, 0) for pair, count in common.items()}


@pytest.fixture
def walls():
    return Walls()


@pytest.mark.slow
def test_photos_of_one_wall_share_what_they_should(walls):
    wall = walls.add_points(0, 12, seed=1)
    walls.add_walk(range(1, 13), np.linspace(3, 9, 12), wall)
    found = find_expected_overlaps(walls.finish()[0])
    assert {(1, 2), (5, 6), (11, 12)} <= found.keys()
    assert all(meeting.shared == meeting.expected for meeting in found.values())
    assert 2 * 12 * 6 < found[5, 6].expected <= 2 * 12 * 9


@pytest.mark.slow
def test_photos_of_two_walls_in_one_place_share_nothing(walls):
    walls.add_walk(range(1, 7), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=1))
    walls.add_walk(range(11, 17), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=2))
    found = find_expected_overlaps(walls.finish()[0])
    across = [meeting for (a, b), meeting in found.items() if (a < 10) != (b < 10)]
    assert len(across) >= 6
    assert all(meeting.shared == 0 < meeting.expected for meeting in across)


@pytest.mark.slow
@pytest.mark.parametrize(("behind", "sides"), [(0.3, 2), (1.5, 1)])
def test_a_photo_expects_nothing_behind_what_it_sees(walls, behind, sides):
    """Those who see the far wall should see the near one, too, and not the other way round."""
    walls.add_walk(range(1, 7), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=1))
    walls.add_walk(range(11, 17), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=2, away=AWAY + behind))
    found = find_expected_overlaps(walls.finish()[0])
    assert (sides - 1) * 12 * 9 < found[3, 13].expected <= sides * 12 * 9


@pytest.mark.slow
def test_a_photo_with_another_focal_length_need_not_match(walls):
    walls.add_walk(range(1, 7), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=1))
    walls.add_walk(range(11, 17), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=2), zoom=1.6)
    assert all((a < 10) == (b < 10) for a, b in find_expected_overlaps(walls.finish()[0]))


@pytest.mark.slow
def test_points_of_two_photos_prove_nothing(walls):
    walls.add_walk((1, 2), (3, 3.5), walls.add_points(0, 9, seed=1))
    walls.add_walk((11, 12), (3, 3.5), walls.add_points(0, 9, seed=2))
    assert find_expected_overlaps(walls.finish()[0]) == {}


@pytest.mark.slow
def test_photos_far_apart_do_not_meet(walls):
    walls.add_walk(range(1, 7), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=1))
    walls.add_walk(range(11, 17), np.linspace(30, 33, 6), walls.add_points(27, 36, seed=2))
    assert all((a < 10) == (b < 10) for a, b in find_expected_overlaps(walls.finish()[0]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("common", "wrong", "is_misplaced"),
    [(12, 6, True), (12, 0, False), (400, 60, False)],
    ids=["contradicted", "blurred: nothing contradicts it", "it shows what it should"],
)
def test_a_photo_that_lacks_what_it_should_show_is_left_out_if_its_matches_contradict_it(
    walls, common, wrong, is_misplaced
):
    wall, other = walls.add_points(0, 12, seed=1), walls.add_points(0, 12, seed=2)
    walls.add_walk(range(1, 13), np.linspace(3, 9, 12), wall)
    near = wall[np.abs(walls.points[wall, 0] - 6.0) < 2.5]
    walls.add_walk([21], [6.0], np.concatenate([near[:common], other]))
    model, explained = walls.finish()
    photos = {key: [end.point3D_id for end in model.images[key].points2D] for key in model.images}
    agreeing = [(photos[6].index(key), row) for row, key in enumerate(photos[21]) if key in photos[6]]
    rows = np.array([*agreeing, *((k, len(photos[21]) - 1 - k) for k in range(wrong))], np.uint32)
    matches = MatchGraph(
        {key: MatchedImage(key, f"{key:03d}.jpg", "camera", WIDTH, HEIGHT) for key in photos},
        {key: np.array([end.xy for end in model.images[key].points2D]) for key in photos},
        {(6, 21): rows},
    )
    fit = EpipolarFit(np.eye(3), np.ones(len(rows), bool), np.ones(len(rows)), 1, 0.1)
    evidence = Evidence(matches, ViewGraph({(6, 21): fit}, {}), Intrinsics({}))
    poses = dict.fromkeys([(5, 6), (6, 7), (6, 21)])
    run = SimpleNamespace(settings=Settings())
    before = Outcome(
        (Attempt("incremental", model, explained, ""),), PoseGraph(poses, {}, ()), evidence, Intrinsics({}), run
    )

    after = without_misplaced(before, [model])

    assert (after is before) is not is_misplaced
    assert after.photos == before.photos - is_misplaced == 13 - is_misplaced
    assert set(after.graph.dropped) == ({(6, 21)} if is_misplaced else set())
    assert all(0.65 < join.missing < 1.0 for join in after.graph.look_alikes)


@pytest.mark.slow
def test_most_photos_of_a_model_stay_in_it(walls, monkeypatch):
    walls.add_walk(range(1, 5), np.linspace(3, 6, 4), walls.add_points(0, 9, seed=1))
    model, explained = walls.finish()
    evidence = Evidence(MatchGraph({}, {}, {}), ViewGraph({}, {}), Intrinsics({}))
    attempt, run = Attempt("incremental", model, explained, ""), SimpleNamespace(settings=Settings())
    before = Outcome((attempt,), PoseGraph({}, {}, ()), evidence, Intrinsics({}), run)
    for misplaced, left in (({1: 0.9}, 3), ({1: 0.9, 2: 0.9}, 4)):
        monkeypatch.setattr(passes, "find_misplaced", lambda *_, found=misplaced: found)
        assert without_misplaced(before, [model]).photos == left


def two_streets(walls, length=24, alike=(10.0, 14.0)):
    """Two walks along different walls in one place; both see the same house in the middle."""
    low, high = alike
    house = walls.add_points(low, high, seed=0)
    for first, seed in ((1, 1), (101, 2)):
        own = np.concatenate([walls.add_points(0, low, seed), walls.add_points(high, length, seed + 10)])
        places = np.arange(3, length - 3, 0.5)
        walls.add_walk(range(first, first + len(places)), places, np.concatenate([own, house]))
    return walls.finish()


@pytest.mark.slow
def test_a_house_in_two_streets_is_found_and_nothing_else(walls):
    model, explained = two_streets(walls)
    joins, non_overlapping = judge_places([Attempt("incremental", model, explained, "")])
    across = {pair for pair, found in explained.items() if pair[0] < 100 < pair[1] and found.matches >= 16}
    assert len(joins) == 1
    assert set(joins[0].pairs) == across
    assert 0.5 < joins[0].missing < 1.0
    assert non_overlapping >= 40


@pytest.mark.slow
def test_one_street_that_is_walked_twice_is_no_false_join(walls):
    wall = walls.add_points(0, 24, seed=1)
    places = np.arange(3, 21, 0.5)
    walls.add_walk(range(1, 1 + len(places)), places, wall)
    walls.add_walk(range(101, 101 + len(places)), places + 0.2, wall, shift=0.3)
    model, explained = walls.finish()
    assert judge_places([Attempt("incremental", model, explained, "")]) == ([], 0)


@pytest.mark.slow
def test_two_sides_with_equal_facades_and_other_gardens_are_told_apart(walls):
    facade = walls.add_points(0, 12, seed=0)
    facade = facade[walls.points[facade, 1] < 1]
    for first, seed in ((1, 1), (101, 2)):
        garden = walls.add_points(0, 12, seed)
        garden = garden[walls.points[garden, 1] > 1]
        walls.add_walk(range(first, first + 12), np.linspace(3, 9, 12), np.concatenate([facade, garden]))
    model, explained = walls.finish()
    (join,), across = judge_places([Attempt("incremental", model, explained, "")])
    assert set(join.pairs) == {(a, b) for a, b in explained if a < 100 < b}
    assert 0.15 < join.missing < 0.35
    assert across >= 60


@pytest.mark.slow
def test_a_loop_where_each_photo_lacks_other_points_stays(walls):
    both, later, places = walls.add_points(0, 12, seed=1), walls.add_points(0, 12, seed=2), np.linspace(3, 9, 12)
    walls.add_walk(range(1, 13), places, both)
    patches = (2 * walls.points[both, :2]).astype(int) @ [1, 100]
    for number, place in enumerate(places):
        lacking = np.random.default_rng(number).permutation(np.unique(patches))[::3]
        walls.add_walk([101 + number], [place], np.concatenate([both[~np.isin(patches, lacking)], later]))
    model, explained = walls.finish()
    shares = [one.shared / one.expected for (a, b), one in find_expected_overlaps(model).items() if a < 100 < b]
    assert 0.8 < np.median(shares) < 0.9
    assert judge_places([Attempt("incremental", model, explained, "")]) == ([], 0)


@pytest.mark.slow
def test_a_loop_whose_ends_were_hardly_matched_stays():
    """A quarter of the photos that should share much share nothing: matching failed, the rest bears the loop out."""
    explained = {(a, 100 + b): PairSupport(200, 200, 0) for a in range(12) for b in range(12) if (a + b) % 4}
    explained |= {(a + side, a + 1 + side): PairSupport(500, 500, 0) for a in range(11) for side in (0, 100)}
    overlaps = {(a, 100 + b): ExpectedOverlap(60, 0 if (a + b) % 4 == 0 else 50) for a in range(12) for b in range(12)}
    beside = [(a + side, b + side) for a in range(12) for b in range(a + 1, min(a + 5, 12)) for side in (0, 100)]
    overlaps |= dict.fromkeys(beside, ExpectedOverlap(60, 58))
    assert len(find_non_overlapping(overlaps, explained)) >= OVERLAPS.min_pairs
    assert find_false_joins(overlaps, explained) == []


@pytest.mark.slow
def test_photos_whose_matches_hold_are_no_strangers():
    overlaps = {(1, 2): ExpectedOverlap(50, 0), (1, 3): ExpectedOverlap(50, 0), (2, 3): ExpectedOverlap(50, 20)}
    found = find_non_overlapping(overlaps, {(1, 2): PairSupport(40, 40, 0), (1, 3): PairSupport(5, 5, 0)})
    assert set(found) == {(1, 3)}


def wrong_side(usual, across):
    """Overlaps of 20 photos, of which four stand on the wrong side of an object and have matches with all others."""
    pairs = [(a, b) for a in range(20) for b in range(a + 1, 20)]
    overlaps = {(a, b): ExpectedOverlap(50, across if a < 4 <= b else usual) for a, b in pairs}
    explained = {(a, b): PairSupport(30 if a < 4 <= b else 200, 200, 0) for a, b in pairs}
    return overlaps, explained


def test_photos_on_the_wrong_side_of_a_symmetric_object_share_less_than_others():
    (join,) = find_false_joins(*wrong_side(usual=48, across=15))
    assert set(join.pairs) == {(a, b) for a in range(4) for b in range(4, 20)}
    assert join.missing == pytest.approx(0.7)


def test_where_all_photos_share_little_none_is_on_a_wrong_side():
    assert find_false_joins(*wrong_side(usual=30, across=15)) == []


@pytest.mark.slow
def test_a_few_strangers_prove_nothing():
    pairs = [(a, a + 100) for a in range(OVERLAPS.min_pairs - 1)]
    explained = {(0, 100): PairSupport(300, 300, 0)} | {
        (a + side, a + 1 + side): PairSupport(500, 500, 0) for a in range(20) for side in (0, 100)
    }
    assert find_false_joins({pair: ExpectedOverlap(60, 0) for pair in pairs}, explained) == []


@pytest.mark.slow
def test_two_false_joins_are_told_apart():
    """Two pairs of streets, each pair on one place, far from each other."""
    overlaps, explained = {}, {}
    for base in (0, 1000):
        for a in range(20):
            for side in (0, 100):
                explained[base + side + a, base + side + a + 1] = PairSupport(500, 500, 0)
                overlaps[base + side + a, base + side + a + 1] = ExpectedOverlap(60, 57)
            for b in range(20):
                alike = 8 <= a <= 10 and 8 <= b <= 10
                overlaps[base + a, base + 100 + b] = ExpectedOverlap(60, 30 if alike else 0)
                if alike:
                    explained[base + a, base + 100 + b] = PairSupport(300, 300, 0)
    explained[20, 1000] = PairSupport(200, 200, 0)
    overlaps[5, 5000] = ExpectedOverlap(40, 20)  # a photo that no pair holds

    found = find_false_joins(overlaps, explained)

    assert len(found) == 2
    for join, base in zip(sorted(found, key=lambda one: one.pairs), (0, 1000), strict=True):
        assert set(join.pairs) == {(base + a, base + 100 + b) for a in (8, 9, 10) for b in (8, 9, 10)}
