from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.camera.models import camera_matrix
from sfm_app.geometry.epipolar import eight_point, sampson_distance
from sfm_app.posegraph import PoseGraphOptions, build_pose_graph, with_model
from sfm_app.posegraph.graph import (
    BEHIND,
    CONTRADICTS,
    NOT_COMPUTABLE,
    TOO_FEW,
    average_pair_rotations,
    guided_pose,
    sample_direction,
)
from sfm_app.posegraph.rotations import connected_groups
from sfm_app.types import (
    Calibration,
    EpipolarFit,
    Evidence,
    Intrinsics,
    MatchedImage,
    MatchGraph,
    PoseGraph,
    Rejected,
    RelativePose,
    ViewGraph,
)

OPTIONS = PoseGraphOptions(max_error_px=1.5, min_inliers=16, seed=0)
K = camera_matrix(900.0, 900.0, 500.0, 375.0)
POINTS = 120


def in_turn(function, items, _):
    return [function(item) for item in items]


def turn(*degrees):
    return Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()


class Photos:
    """Photos around places, with matches of every pair within a place."""

    def __init__(self, places, noise_px=0.2):
        rng = np.random.default_rng(7)
        self.rng, self.noise_px = rng, noise_px
        self.keypoints, self.rows, self.rejected, self.poses = {}, {}, {}, {}
        for photos in places:
            X = rng.uniform([-2, -1.5, -1.5], [2, 1.5, 1.5], (POINTS, 3))
            for number, photo in enumerate(photos):
                R = turn(*rng.uniform(-4, 4, 2), 0) @ turn(0, 9.0 * number, 0)
                self.poses[photo] = R, np.array([0, 0, 6.0]) + rng.uniform(-0.3, 0.3, 3)
                self.keypoints[photo] = self.seen(X, *self.poses[photo])
            for pair in combinations(photos, 2):
                self.rows[pair] = np.tile(np.arange(POINTS)[:, None], 2)

    def seen(self, X, R, t):
        Y = X @ R.T + t
        return Y[:, :2] / Y[:, 2:] * 900.0 + [500, 375] + self.rng.normal(0, self.noise_px, (len(X), 2))

    def match(self, pair, x1, x2):
        """Give a pair these matches and no others."""
        self.rows[pair] = np.column_stack([len(self.keypoints[k]) + np.arange(len(x1)) for k in pair])
        for photo, x in zip(pair, (x1, x2), strict=True):
            self.keypoints[photo] = np.vstack([self.keypoints[photo], x])

    def elsewhere(self, pair, degrees, count=100):
        """Matches of a place that looks the same from another side."""
        X = self.rng.uniform([-2, -1.5, 4.5], [2, 1.5, 7.5], (count, 3))
        R = turn(0, degrees, 0) @ self.rotation(pair)
        self.match(
            pair, self.seen(X, np.eye(3), np.zeros(3)), self.seen(X @ R.T, np.eye(3), np.array([-1.0, 0.2, 0.5]))
        )

    def spoil(self, pair, right):
        """Leave a pair so many right matches, and false ones instead of the others."""
        rows = self.rows[pair].copy()
        rows[right:, 1] = self.rng.permutation(rows[right:, 1])
        self.rows[pair] = rows

    def rotation(self, pair):
        return self.poses[pair[1]][0] @ self.poses[pair[0]][0].T

    def error_deg(self, R, pair):
        return np.degrees(Rotation.from_matrix(R @ self.rotation(pair).T).magnitude())

    @property
    def matches(self):
        images = {key: MatchedImage(key, f"{key}.jpg", "one", 1000, 750) for key in sorted(self.keypoints)}
        return MatchGraph(images, self.keypoints, dict(sorted(self.rows.items())))

    @property
    def views(self):
        matches, fits = self.matches, {}
        for pair in matches.matches:
            if pair not in self.rejected:
                x1, x2 = matches.points(pair)
                F = eight_point(x1, x2)
                inliers = sampson_distance(F, x1, x2) <= 1.5
                fits[pair] = EpipolarFit(F, inliers, np.ones(len(x1)), 10, 0.3)
        return ViewGraph(fits, self.rejected)

    def graph(self, run_map=in_turn, **camera):
        one = Calibration(
            **{"K": K, "width": 1000, "height": 750, "method": "zero-curves", "identifiable": True, **camera}
        )
        return build_pose_graph(Evidence(self.matches, self.views, Intrinsics({"one": one})), OPTIONS, run_map)


SIX = (1, 2, 3, 4, 5, 6)


def test_photos_of_one_place_hang_together():
    photos = Photos([SIX])
    graph = photos.graph()
    assert list(graph.poses) == list(combinations(SIX, 2)) and graph.dropped == {}
    assert graph.groups == (SIX,)
    rotations = average_pair_rotations(graph.poses)[0]
    errors = [photos.error_deg(rotations[j] @ rotations[i].T, (i, j)) for i, j in graph.poses]
    assert 0.001 < max(errors) < 0.3
    assert not any(pose.guided for pose in graph.poses.values())


def test_a_pair_that_saw_another_place_contradicts_the_others():
    photos = Photos([SIX])
    photos.elsewhere((2, 5), 40.0)
    photos.elsewhere((1, 3), 3.0)  # too near to the others to contradict them
    graph = photos.graph()
    assert graph.dropped == {(2, 5): CONTRADICTS}
    assert (2, 5) not in graph.poses and (1, 3) in graph.poses
    assert graph.groups == (SIX,)


def test_a_pair_that_the_estimator_rejected_comes_back_with_the_help_of_others():
    photos = Photos([SIX])
    photos.spoil((1, 5), 40)
    photos.spoil((2, 6), 5)
    for pair in ((1, 5), (2, 6)):
        photos.rejected[pair] = Rejected("too few inliers")

    graph = photos.graph()

    assert [pair for pair, pose in graph.poses.items() if pose.guided] == [(1, 5)]
    assert (2, 6) not in graph.poses and graph.dropped == {}
    assert photos.error_deg(graph.poses[1, 5].R, (1, 5)) < 0.5
    assert 35 < graph.poses[1, 5].inlier_count < 60


def test_a_pair_dropped_by_its_F_comes_back_when_its_matches_bear_the_others_out():
    photos = Photos([SIX])
    rows = photos.rows[2, 5]
    photos.elsewhere((2, 5), 40.0, count=60)
    photos.rows[2, 5] = np.vstack([photos.rows[2, 5], rows[:60]])
    photos_views = photos.views.fits
    F = eight_point(*(x[:60] for x in photos.matches.points((2, 5))))
    inliers = sampson_distance(F, *photos.matches.points((2, 5))) <= 1.5
    fits = photos_views | {(2, 5): EpipolarFit(F, inliers, np.ones(120), 10, 0.3)}
    one = Intrinsics({"one": Calibration(K, 1000, 750, "zero-curves", True)})

    graph = build_pose_graph(Evidence(photos.matches, ViewGraph(fits, {}), one), OPTIONS, in_turn)

    assert graph.dropped == {}
    assert graph.poses[2, 5].guided and graph.poses[2, 5].inliers[60:].mean() > 0.9
    assert photos.error_deg(graph.poses[2, 5].R, (2, 5)) < 0.5


def test_two_places_are_two_groups_the_larger_one_first():
    photos = Photos([(1, 2, 9), (3, 4, 5, 6)])
    photos.rows[2, 3] = np.tile(np.arange(POINTS)[:, None], 2)
    photos.rejected[2, 3] = Rejected("too few inliers")

    graph = photos.graph()

    assert graph.groups == ((3, 4, 5, 6), (1, 2, 9))
    assert (2, 3) not in graph.poses
    assert graph.connected_photos(9) == (1, 2, 9) and graph.connected_photos(7) == ()
    np.testing.assert_allclose(
        [average_pair_rotations(graph.poses)[0][photo] for photo in (1, 3)], [np.eye(3)] * 2, atol=0.01
    )


def test_where_cameras_are_guesses_pairs_keep_the_inliers_of_F():
    photos = Photos([SIX])
    photos.spoil((1, 5), 40)
    photos.rejected[1, 5] = Rejected("too few inliers")
    graph = photos.graph(method="guess", identifiable=False)
    assert {pose.kind for pose in graph.poses.values()} == {"uncalibrated"}
    fits = photos.views.fits
    assert all(np.array_equal(pose.inliers, fits[pair].inliers) for pair, pose in graph.poses.items())
    assert (1, 5) not in graph.poses  # a rotation that rests on guesses helps nobody


def test_guessed_cameras_bend_all_pairs_and_none_is_blamed_for_it():
    """With three times the focal, right pairs are up to 17 degrees from their photos' rotations, half of them 4.5."""
    graph = Photos([SIX]).graph(K=camera_matrix(3000.0, 3000.0, 500.0, 375.0), method="guess", identifiable=False)
    assert graph.dropped == {}
    photos = Photos([SIX])
    photos.elsewhere((2, 5), 40.0)
    assert photos.graph(method="guess", identifiable=False).dropped == {(2, 5): CONTRADICTS}


def test_a_pair_that_fits_no_camera_and_one_behind_them_say_so():
    photos = Photos([(1, 2, 3), (7, 8)])
    x1, x2 = photos.matches.points((7, 8))
    half = POINTS // 2  # half of the matches the wrong way round: epipolar lines of a pure shift do not see it
    photos.poses[8] = photos.poses[7][0], photos.poses[7][1] + [-0.8, 0, 0]
    X = photos.rng.uniform([-2, -1.5, -1.5], [2, 1.5, 1.5], (POINTS, 3))
    x1, x2 = (photos.seen(X, *photos.poses[key]) for key in (7, 8))
    photos.match((7, 8), np.vstack([x1[:half], x2[half:]]), np.vstack([x2[:half], x1[half:]]))
    photos.match((1, 2), *(photos.rng.uniform((0, 0), (1000, 750), (12, 2)) for _ in range(2)))

    graph = photos.graph()

    assert graph.dropped == {(1, 2): TOO_FEW, (7, 8): BEHIND}
    assert graph.groups == ((1, 2, 3),)


def test_results_do_not_depend_on_the_order_in_which_pairs_are_done():
    def backwards(function, items, _):
        return [function(item) for item in reversed(items)][::-1]

    photos = Photos([SIX])
    photos.elsewhere((2, 5), 40.0)
    photos.spoil((1, 5), 40)
    photos.rejected[1, 5] = Rejected("too few inliers")

    first, second = photos.graph(), photos.graph(backwards)

    assert [(pair, pose.t.tobytes()) for pair, pose in first.poses.items()] == [
        (pair, pose.t.tobytes()) for pair, pose in second.poses.items()
    ]
    assert first.dropped == second.dropped and first.groups == second.groups


@pytest.mark.parametrize("order", [1, -1])
def test_photos_that_hang_together(order):
    pairs = [(1, 2), (3, 4), (5, 6), (2, 3), (8, 9)][::order]
    assert connected_groups(pairs) == [{1, 2, 3, 4}, {5, 6}, {8, 9}]
    assert connected_groups(pairs, range(1, 8)) == [{1, 2, 3, 4}, {5, 6}, {8, 9}, {7}]
    assert connected_groups([]) == []


def test_a_pair_whose_inliers_lie_in_one_point_has_no_pose_and_the_others_have_theirs():
    photos = Photos([[1, 2, 3]])
    views = photos.views
    photos.match((1, 2), np.random.default_rng(0).uniform(0, 700, (40, 2)), np.full((40, 2), 300.0))
    fits = {**views.fits, (1, 2): EpipolarFit(np.diag([1.0, 1.0, 0.0]), np.ones(40, bool), np.ones(40), 1, 0.1)}
    bent = Intrinsics({"one": Calibration(K, 1000, 750, "zero-curves", True, distortion=(-1e-3,))})
    graph = build_pose_graph(Evidence(photos.matches, ViewGraph(fits, views.rejected), bent), OPTIONS, in_turn)
    assert graph.dropped == {(1, 2): NOT_COMPUTABLE}
    assert sorted(graph.poses) == [(1, 3), (2, 3)] and graph.groups == ((1, 2, 3),)


def test_pairs_on_a_plane_count_little_where_rotations_are_averaged():
    """Three photos; the planar pair says that the second is turned by 40 degrees more than both others together say."""
    turn = [Rotation.from_rotvec([0.0, np.radians(angle), 0.0]).as_matrix() for angle in (0.0, 10.0, 20.0)]
    aside = Rotation.from_rotvec([0.0, np.radians(40.0), 0.0]).as_matrix()

    def pose(R):
        return RelativePose(R, np.array([1.0, 0.0, 0.0]), np.ones(60, bool), 10.0, 1.0, "calibrated", False)

    poses = {(1, 2): pose(turn[1]), (2, 3): pose(turn[1]), (1, 3): pose(aside @ turn[2])}
    off = average_pair_rotations(poses, {(1, 3)})[1]
    even = average_pair_rotations(poses)[1]

    assert off[1, 3] > 30.0 > 10.0 > max(off[1, 2], off[2, 3])
    assert off[1, 3] >= even[1, 3]


def test_a_graph_takes_over_the_poses_of_a_model():
    def pose(sign=1.0):
        return RelativePose(sign * np.eye(3), np.eye(3)[0], np.ones(20, bool), 10.0, 1.0)

    before = PoseGraph({(1, 2): pose(), (2, 3): pose(), (3, 4): pose()}, {(1, 3): TOO_FEW}, ((1, 2, 3, 4),))
    after = with_model(before, {1, 2, 3}, {(1, 2): pose(-1.0), (1, 3): pose()})

    assert list(after.poses) == [(1, 2), (1, 3), (3, 4)] and after.poses[1, 2].R[0, 0] == -1
    assert after.dropped == {(2, 3): CONTRADICTS}
    assert after.groups == ((1, 2, 3, 4),)


LEAST = 16


def off(views, degrees):
    return Rotation.from_euler("xyz", [0.4 * degrees, 0.9 * degrees, 0.1 * degrees], degrees=True).as_matrix() @ views.R


@pytest.mark.parametrize("seed", range(4))
def test_with_the_rotation_known_a_fifth_of_right_matches_is_enough(two_views, seed):
    views = two_views(seed, right=60, false=240)
    pose = guided_pose(views.pair(), off(views, 0.5), LEAST, seed)
    assert pose.guided and pose.kind == "calibrated"
    assert 0.001 < views.errors_deg(pose.R, pose.t).max() < 0.6
    assert pose.inliers[:60].mean() > 0.95 and pose.inliers[60:].mean() < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_with_a_wrong_rotation_nothing_is_believed(two_views, seed):
    views = two_views(seed, right=60, false=240)
    assert guided_pose(views.pair(), off(views, 20.0), LEAST, seed) is None


@pytest.mark.parametrize(("degrees", "believed"), [(1.5, True), (2.5, False), (4.0, False)])
def test_a_pose_that_leaves_the_rotation_it_was_given_is_not_believed(two_views, degrees, believed):
    """All matches are right, and the fit finds the true pose each time."""
    views = two_views()
    assert (guided_pose(views.pair(), off(views, degrees), LEAST, 0) is not None) == believed


@pytest.mark.parametrize(("reversed_matches", "believed"), [(0, True), (6, True), (20, False)])
def test_a_pose_with_matches_behind_the_cameras_is_not_believed(two_views, reversed_matches, believed):
    """In a shift along x, a match the wrong way round lies on its epipolar line, behind the cameras."""
    views = two_views(R=np.eye(3), t=np.array([1.0, 0.0, 0.0]))
    x1, x2 = views.x1.copy(), views.x2.copy()
    x1[:reversed_matches], x2[:reversed_matches] = views.x2[:reversed_matches], views.x1[:reversed_matches]
    pose = guided_pose(replace(views, x1=x1, x2=x2).pair(), np.eye(3), LEAST, 0)
    assert (pose is not None) == believed


def test_a_step_too_short_to_be_seen_gives_no_direction(two_views):
    """Its points lie before both cameras, but a turn alone explains them, too."""
    short, long = (two_views(t=step * two_views().t, noise_px=0.05) for step in (0.01, 0.2))
    assert guided_pose(short.pair(), short.R, LEAST, 0) is None
    assert guided_pose(long.pair(), long.R, LEAST, 0) is not None


def test_matches_of_nothing_are_not_believed(two_views):
    views = two_views(right=0, false=200)
    assert [guided_pose(views.pair(), views.R, LEAST, seed) for seed in range(5)] == [None] * 5


def test_a_turn_has_no_direction_to_find(two_views):
    views = two_views(scene="turn", false=50)
    assert guided_pose(views.pair(), views.R, LEAST, 0) is None


def test_too_few_matches_are_not_looked_at(two_views):
    assert guided_pose(two_views(right=15).pair(), two_views().R, LEAST, 0) is None
    assert guided_pose(two_views(right=16).pair(), two_views().R, LEAST, 0).inlier_count == 16


def test_the_direction_points_to_where_the_matches_lie_before_both_cameras(two_views):
    for sign in (1.0, -1.0):
        t = sign * two_views().t * [1, 1, 0.2]
        views = two_views(t=t / np.linalg.norm(t), noise_px=0.1)
        found = sample_direction(views.pair(), views.R, np.random.default_rng(0))
        assert views.errors_deg(views.R, found)[1] < 3.0


@pytest.mark.parametrize("seed", range(10))
def test_few_and_wild_matches_never_raise(two_views, seed):
    """Whatever is near the sampled direction may be gone once the pose is fitted."""
    views = two_views(seed, right=0, false=16, noise_px=0.0)
    guided_pose(views.pair(), views.R, 2, seed)
