import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.synthetic.matches import make_place, match_photos
from sfm_app.geometry.epipolar import cross_matrix
from sfm_app.posegraph import PoseGraphOptions, build_pose_graph
from sfm_app.posegraph import look_alikes as module
from sfm_app.posegraph.graph import LOOKS_ALIKE
from sfm_app.posegraph.look_alikes import backbone, find_look_alikes, group_doubted_pairs
from sfm_app.synthetic.cameras import look_at
from sfm_app.types import EpipolarFit, Intrinsics, ViewGraph


def turn(degrees):
    return Rotation.from_euler("y", degrees, degrees=True).as_matrix()


def view(center, aim):
    pose = look_at(np.array(center, float), np.array(aim, float))
    return pose[:, :3], pose[:, 3]


def box(rng, count, at=0.0):
    return rng.uniform([-0.5, -0.7, -0.2], [0.5, 0.7, 0.2], (count, 3)) + np.array([at, 0.0, 0.0])


def from_all_sides(X):
    return X, np.zeros_like(X)


def walk(seed, *, twice):
    """Four boxes in a row before a wall; the first and the last are equal, or not."""
    rng = np.random.default_rng(seed)
    wall = rng.uniform([-3.0, -2.0, 2.5], [12.0, 2.0, 4.0], (400, 3))
    between = [box(rng, 250, at) for at in (3.0, 6.0)]
    first, last = box(rng, 250), box(rng, 250)
    home, away = (turn(0), np.zeros(3)), (turn(5), np.array([9.0, 0.0, 0.2]))
    things = [(first, [home, away])] if twice else [(first, [home]), (last, [away])]
    place = make_place(
        from_all_sides(np.vstack([wall, *between])), [(from_all_sides(thing), stands) for thing, stands in things]
    )
    ways = [view([x, 0.1 * np.sin(3 * x), -3.0], [x + 0.1 * np.cos(x), 0.0, 0.0]) for x in np.linspace(-0.5, 9.5, 24)]
    return match_photos(place, ways, seed)


def orbit(seed, photos=24, nearer=4.0, farther=4.0):
    """All round a ball, in a room."""
    rng = np.random.default_rng(seed)
    ball, room = (X / np.linalg.norm(X, axis=1)[:, None] for X in (rng.normal(size=(n, 3)) for n in (2500, 300)))
    X = np.vstack([ball, room * rng.uniform(8.0, 12.0, (300, 1))])
    place = make_place((X, np.vstack([ball, np.zeros_like(room)])), [])
    angles = np.linspace(0, 2 * np.pi, photos, endpoint=False)
    ways = np.linspace(nearer, farther, photos)
    centers = [[r * np.cos(t), 0.2 * np.sin(2 * t), r * np.sin(t)] for t, r in zip(angles, ways, strict=True)]
    return match_photos(place, [view(center, [0, 0, 0]) for center in centers], seed)


def can(seed, photos=36):
    """All round a can whose print is on its front and again on its back, in a room."""
    rng = np.random.default_rng(seed)
    angles, heights = rng.uniform(-np.pi / 2, np.pi / 2, 1000), rng.uniform(-1.0, 1.0, 1000)
    normals = np.column_stack([np.cos(angles), np.zeros(1000), np.sin(angles)])
    printed = normals + np.outer(heights, [0.0, 1.0, 0.0])
    sides, far = rng.uniform(0, 2 * np.pi, 500), rng.uniform(3.0, 6.0, 500)
    room = np.column_stack([far * np.cos(sides), rng.uniform(-2.0, 2.0, 500), far * np.sin(sides)])
    stands = [(turn(0), np.zeros(3)), (turn(180), np.zeros(3))]
    place = make_place(from_all_sides(room), [((printed, normals), stands)], pillar=1.0)
    turns = np.linspace(0, 2 * np.pi, photos, endpoint=False)
    centers = [[5.5 * np.cos(t), 0.2 * np.sin(3 * t) - 1.0, 5.5 * np.sin(t)] for t in turns]
    return match_photos(place, [view(center, [0, 0, 0]) for center in centers], seed)


def told_apart(scene):
    found = find_look_alikes(scene.matches, scene.poses, scene.cameras)
    return found, {pair for join in found.joins for pair in join.pairs}


@pytest.mark.parametrize("seed", range(3))
def test_two_equal_boxes_at_the_ends_of_a_walk_are_told_apart(seed):
    scene = walk(seed, twice=True)
    false = scene.poses.keys() - scene.true_pairs
    found, dropped = told_apart(scene)
    assert len(false) > 20 and len(dropped - false) <= 1
    assert len(false - dropped) <= 0.2 * len(false)  # what is left has few matches
    assert len(found.joins) == 1 and 0.35 < found.joins[0].missing < 0.7


@pytest.mark.parametrize("seed", range(3))
def test_boxes_that_differ_join_nothing(seed):
    scene = walk(seed, twice=False)
    assert len(scene.true_pairs) == len(scene.poses) > 100
    found, _ = told_apart(scene)
    assert found.joins == found.doubtful == ()


@pytest.mark.parametrize("farther", [4.0, 6.0])
def test_an_orbit_stays_closed(farther):
    scene = orbit(0, farther=farther)
    across = [(a, b) for a, b in scene.poses if b - a > 12]
    assert len(across) >= 2
    assert told_apart(scene)[0].joins == ()


def test_the_two_sides_of_a_can_are_told_apart_by_the_room_behind_it():
    scene = can(0)
    false = scene.poses.keys() - scene.true_pairs
    _, dropped = told_apart(scene)
    assert len(false) > 80 and dropped <= false
    assert len(false - dropped) <= 0.2 * len(false)


def test_a_loop_that_its_tracks_do_not_bear_out_stays_where_nothing_is_missing(monkeypatch):
    """Without its best pairs, closing the loop contradicts the backbone; what it should show, it shows."""
    scene = orbit(1, photos=36)
    loose = {pair for pair in scene.poses if pair[1] - pair[0] > 18}

    def without_loose(covered):
        return backbone({pair: value for pair, value in covered.items() if pair not in loose})

    monkeypatch.setattr(module, "backbone", without_loose)

    found, dropped = told_apart(scene)

    rows = {pair: scene.matches.matches[pair][scene.poses[pair].inliers].astype(np.int64) for pair in loose}
    assert any(found.tracks.is_contradicted_by(pair, rows[pair]) for pair in loose)
    assert not dropped and found.doubtful == (), "it turns as the way does, and nothing is missing"


def test_a_pair_that_is_found_later_is_asked_as_well():
    scene = walk(0, twice=True)
    found, dropped = told_apart(scene)
    true, false = max(scene.true_pairs, key=lambda pair: len(scene.matches.matches[pair])), max(dropped)
    rows = {pair: scene.matches.matches[pair][scene.poses[pair].inliers] for pair in (true, false)}
    assert found.is_look_alike(false, rows[false]) and not found.is_look_alike(true, rows[true])


def test_doubted_pairs_between_the_same_places_are_one_join():
    trusted = [(1, 2), (2, 3), (2, 30), (11, 12), (21, 22)]
    assert group_doubted_pairs([(1, 11), (2, 12), (3, 21), (12, 30)], trusted) == [
        ((1, 11), (2, 12), (12, 30)),
        ((3, 21),),
    ]


def test_the_backbone_holds_what_no_better_way_leads_round():
    covered = {(1, 2): 0.9, (2, 3): 0.8, (1, 3): 0.73, (3, 4): 0.4, (1, 4): 0.35}
    assert backbone(covered) == {(1, 2), (2, 3), (1, 3), (3, 4)}


def test_nothing_is_found_among_no_pairs():
    scene = walk(0, twice=True)
    assert find_look_alikes(scene.matches, {}, scene.cameras).joins == ()


@pytest.mark.slow
def test_the_pose_graph_does_without_look_alikes():
    scene = walk(0, twice=True)
    K = scene.cameras[1].K
    inverse = np.linalg.inv(K)
    fits = {
        pair: EpipolarFit(
            inverse.T @ cross_matrix(pose.t) @ pose.R @ inverse, pose.inliers, np.ones(len(pose.inliers)), 1, 0.3
        )
        for pair, pose in scene.poses.items()
    }
    names = {photo: image.name for photo, image in scene.matches.images.items()}
    intrinsics = Intrinsics({"camera": scene.cameras[1]}, dict.fromkeys(names.values(), "camera"), names)

    graph = build_pose_graph(
        scene.matches,
        ViewGraph(fits, {}),
        intrinsics,
        PoseGraphOptions(max_error_px=1.5, min_inliers=16, seed=0),
        lambda function, items, _: [function(item) for item in items],
    )

    apart = {pair for pair, reason in graph.dropped.items() if reason == LOOKS_ALIKE}
    assert len(graph.groups[0]) == 24 and graph.doubtful == ()
    assert apart == {pair for join in graph.look_alikes for pair in join.pairs} and len(apart) > 15
    assert len(apart - scene.true_pairs) >= len(apart) - 1 and apart.isdisjoint(graph.poses)
    assert len(graph.poses.keys() & scene.true_pairs) > 0.8 * len(scene.true_pairs)
