import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.geometry.epipolar import eight_point
from sfm_app.mapping.attempt import agreement, coverage, rank_seeds, triangulate_seed
from sfm_app.posegraph.pair_pose import Pair, estimate_pose
from sfm_app.types import Calibration, EpipolarFit, Intrinsics, MatchedImage, MatchGraph, PoseGraph, RelativePose

K = camera_matrix(800.0, 800.0, 320.0, 240.0)
POINTS = 120


def known(radial=0.0, key_pairs=(), K=K):
    return Calibration(K, 640, 480, "zero-curves", True, radial=radial, key_pairs=key_pairs)


def two_views(radial=0.0):
    """Two photos that look at the same points from places a step apart, through a lens, with noise."""
    rng = np.random.default_rng(4)
    X = rng.uniform([-2, -1.5, 5], [2, 1.5, 8], (POINTS, 3))
    keypoints = {}
    for key in (1, 2):
        x = (X - [0.8 * (key - 1), 0, 0])[:, :2] / X[:, 2:]
        keypoints[key] = (x * (1 + radial * (x**2).sum(1, keepdims=True))) * 800 + [320, 240]
        keypoints[key] += rng.normal(scale=0.2, size=x.shape)
    images = {key: MatchedImage(key, f"{key}.jpg", "one", 640, 480) for key in keypoints}
    return MatchGraph(images, keypoints, {(1, 2): np.tile(np.arange(POINTS, dtype=np.uint32)[:, None], 2)})


def seeded(matches, intrinsics):
    """The seed of the one pair, its pose found with these cameras."""
    cameras = [intrinsics.camera(matches.images[key]) for key in (1, 2)]
    x1, x2 = matches.points((1, 2))
    fit = EpipolarFit(eight_point(x1, x2), np.ones(POINTS, bool), np.ones(POINTS), 10, 0.3)
    graph = PoseGraph({(1, 2): estimate_pose(Pair((x1, x2), cameras, 1.5), fit)}, {}, ())
    [candidate] = rank_seeds(matches, graph, intrinsics, (1, 2), 2.0)
    return triangulate_seed(matches, candidate, intrinsics)


def test_a_seed_is_made_from_what_the_photos_show_without_their_lens():
    matches = two_views(radial=-0.25)

    straight, bent = (seeded(matches, Intrinsics({"one": known(radial)})) for radial in (-0.25, 0.0))

    off = [np.degrees(np.arccos(min(1, (np.trace(seed.R) - 1) / 2))) for seed in (straight, bent)]
    assert off[0] < 0.3 < off[1]
    assert abs(straight.t @ [-1, 0, 0]) > 0.9999
    assert np.median(straight.points[:, 2]) * 0.8 == pytest.approx(6.5, abs=0.5)
    assert np.count_nonzero(straight.usable) > 100


def test_cameras_are_those_that_took_the_photos_not_those_of_their_group():
    matches = two_views()
    other = known(K=np.diag([2.0, 2.0, 1.0]) @ K)
    apart = Intrinsics({"one": other, "one #2": known()}, {"1.jpg": "one #2", "2.jpg": "one #2"})

    right, wrong = seeded(matches, Intrinsics({"one": known()})), seeded(matches, Intrinsics({"one": other}))

    assert np.array_equal(seeded(matches, apart).points, right.points)
    assert not np.allclose(wrong.points, right.points, rtol=0.1)


def photos(count=4, spread=1.0):
    """Photos whose keypoints fill the given share of their sides."""
    x = np.random.default_rng(0).uniform((0, 0), (640 * spread, 480 * spread), (400, 2))
    images = {key: MatchedImage(key, f"{key}.jpg", "one", 640, 480) for key in range(1, count + 1)}
    return images, {key: x.copy() for key in images}


def pose(inliers=200, angle_deg=10.0, in_front=1.0, kind="calibrated"):
    return RelativePose(np.eye(3), np.array([1.0, 0, 0]), np.arange(400) < inliers, angle_deg, in_front, kind)


def order(poses, camera=None, members=(1, 2, 3, 4), keypoints=None, least_deg=2.0):
    images, usual = photos()
    rows = np.tile(np.arange(400, dtype=np.uint32)[:, None], 2)
    matches = MatchGraph(images, usual | (keypoints or {}), dict.fromkeys(poses, rows))
    graph = PoseGraph(poses, {}, ())
    found = rank_seeds(matches, graph, Intrinsics({"one": camera or known()}), members, least_deg)
    assert [candidate.score for candidate in found] == sorted((c.score for c in found), reverse=True)
    return [candidate.pair for candidate in found]


def test_a_wide_angle_comes_before_a_narrow_one_until_it_is_wide_enough():
    assert order({(1, 2): pose(angle_deg=4), (1, 3): pose(angle_deg=9)}) == [(1, 3), (1, 2)]
    assert order({(1, 2): pose(angle_deg=15, inliers=210), (1, 3): pose(angle_deg=30)}) == [(1, 2), (1, 3)]
    assert order({(1, 2): pose(angle_deg=1.9), (1, 3): pose(angle_deg=2.0)}) == [(1, 3)]
    assert order({(1, 2): pose(angle_deg=1.9), (1, 3): pose(angle_deg=2.0)}, least_deg=1.0) == [(1, 3), (1, 2)]


def test_many_points_come_before_few_and_points_behind_a_camera_count_strongly_against():
    assert order({(1, 2): pose(100), (1, 3): pose(200)}) == [(1, 3), (1, 2)]
    assert order({(1, 2): pose(200, in_front=0.8), (1, 3): pose(110)}) == [(1, 3), (1, 2)]


def test_pairs_that_agree_with_the_camera_start_before_pairs_that_do_not():
    poses = {(1, 2): pose(100), (1, 3): pose(300)}

    assert order(poses) == [(1, 3), (1, 2)]
    assert order(poses, known(key_pairs=((1, 2),))) == [(1, 2), (1, 3)]


def test_only_photos_of_one_camera_can_contradict_it():
    one, two = known(key_pairs=((1, 2),)), known(key_pairs=((3, 4),))

    assert agreement((1, 2), (one, one)) == 1.0
    assert 0.0 < agreement((1, 3), (one, one)) < 0.5
    assert agreement((1, 3), (one, two)) == 1.0
    assert agreement((1, 3), (known(), known())) == 1.0


def test_a_turn_never_starts_and_a_wall_starts_later():
    poses = {(1, 2): pose(kind="rotation", angle_deg=20), (1, 3): pose(kind="planar"), (2, 3): pose(150)}

    assert order(poses) == [(2, 3), (1, 3)]


def test_only_pairs_within_the_group_start():
    poses = {(1, 2): pose(), (2, 3): pose(), (3, 4): pose()}

    assert order(poses, members=(1, 2, 3)) == [(1, 2), (2, 3)]
    assert order(poses, members=(1, 4)) == []


def test_points_all_over_the_photos_come_before_a_clump():
    _, clump = photos(4, spread=0.2)
    poses = {(1, 2): pose(220), (3, 4): pose(200)}

    assert order(poses, keypoints={1: clump[1], 2: clump[2]}) == [(3, 4), (1, 2)]


def test_coverage_is_the_share_of_cells_that_the_points_could_fill():
    images, _ = photos(2)
    cells = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1).reshape(-1, 2) + 0.5) * [80, 60]
    rows = {(1, 2): np.tile(np.arange(64, dtype=np.uint32)[:, None], 2)}

    def share(first, second, inliers):
        found = RelativePose(np.eye(3), np.ones(3), np.arange(64) < inliers, 10.0, 1.0)
        return coverage(MatchGraph(images, {1: first, 2: second}, rows), (1, 2), found)

    corner = np.tile([[5.0, 5.0]], (64, 1))
    assert share(cells, cells, 64) == 1.0
    assert share(cells, cells, 10) == 1.0  # ten points cannot fill more than ten cells
    assert share(cells, corner, 64) == pytest.approx(np.sqrt(1 / 64))
    assert share(cells, np.tile([[640.0, 480.0]], (64, 1)), 64) == pytest.approx(np.sqrt(1 / 64))  # on the border
    assert share(cells, cells, 0) == 0.0
