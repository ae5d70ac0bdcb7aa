"""Seeds, support, reasons, and the mappers of one group."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.colmap.backend import pycolmap
from sfm_app.errors import BackendError
from sfm_app.geometry.epipolar import eight_point
from sfm_app.mapping import attempt as module
from sfm_app.mapping.attempt import (
    NOT_NEEDED,
    Attempt,
    ColmapMappers,
    Group,
    NoModel,
    PairSupport,
    agreement,
    are_many_unregistered,
    best_attempt,
    choice_reason,
    coverage,
    explained_pairs,
    map_group,
    model_poses,
    pairs_to_map,
    rank_seeds,
    support,
    triangulate_seed,
    unregistered_reasons,
)
from sfm_app.posegraph.graph import BEHIND, CONTRADICTS, TOO_FEW
from sfm_app.posegraph.pair_pose import Pair, estimate_pose
from sfm_app.posegraph.rotations import connected_groups
from sfm_app.types import (
    Calibration,
    EpipolarFit,
    Evidence,
    Intrinsics,
    MatchedImage,
    MatchGraph,
    PoseGraph,
    RelativePose,
    ViewGraph,
)

K = camera_matrix(800.0, 800.0, 320.0, 240.0)
POINTS = 120


def known(radial=0.0, key_pairs=(), K=K):
    return Calibration(K, 640, 480, "zero-curves", True, distortion=(radial,), key_pairs=key_pairs)


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
    evidence = Evidence(matches, ViewGraph({}, {}), intrinsics)
    [candidate] = rank_seeds(Group((1, 2), evidence, graph), 2.0)
    return triangulate_seed(candidate, evidence)


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
    evidence = Evidence(matches, ViewGraph({}, {}), Intrinsics({"one": camera or known()}))
    found = rank_seeds(Group(members, evidence, PoseGraph(poses, {}, ())), least_deg)
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


def explained(model, synthetic, views=None):
    return explained_pairs(model, replace(synthetic.evidence(), views=views or synthetic.views), 1.5)


def turned(model, photo, degrees):
    """Turn a photo on the spot."""
    pose = model.images[photo].cam_from_world()
    turn = pycolmap.Rotation3d(np.radians(degrees) * np.array([0.0, 1.0, 0.0]))
    model.frames[model.images[photo].frame_id].rig_from_world = pycolmap.Rigid3d(turn, np.zeros(3)) * pose


def test_the_true_model_explains_all_right_matches_and_contradicts_none(synthetic):
    found = explained(synthetic.model, synthetic)
    assert list(found) == list(synthetic.matches.matches)
    assert all(pair.inliers == 100 and pair.contradicted == 0 for pair in found.values())
    assert all(100 <= pair.matches <= 115 for pair in found.values())
    assert np.mean([pair.matches for pair in found.values()]) < 108  # 20 matches of each pair are false


def test_a_photo_that_looks_the_wrong_way_contradicts_its_pairs_and_no_others(synthetic):
    model = synthetic.copy()
    turned(model, 3, 5.0)
    found = explained(model, synthetic)
    for pair, counts in found.items():
        assert (counts.contradicted > 60) == (3 in pair), pair
        assert (counts.matches < 50) == (3 in pair), pair
    assert support(found) < 0.8 * support(explained(synthetic.model, synthetic))


def test_points_behind_a_camera_are_not_explained(synthetic):
    """With photo 2 beyond photo 1 on the other side, epipolar lines stay and points change sides."""
    model = synthetic.copy()
    first, second = (model.images[key].cam_from_world().matrix() for key in (1, 2))
    center = [-pose[:, :3].T @ pose[:, 3] for pose in (first, second)]
    there = 2.0 * center[0] - center[1]
    moved = pycolmap.Rigid3d(pycolmap.Rotation3d(second[:, :3]), -second[:, :3] @ there)
    model.frames[model.images[2].frame_id].rig_from_world = moved
    found = explained(model, synthetic)
    assert found[1, 2].matches < 10 and found[1, 2].contradicted == 100


def test_only_pairs_of_photos_with_a_place_are_asked(synthetic):
    model = synthetic.copy()
    model.deregister_frame(model.images[6].frame_id)
    assert set(explained(model, synthetic)) == {pair for pair in synthetic.matches.matches if 6 not in pair}


def test_a_pair_without_F_contradicts_nothing_but_counts(synthetic):
    fits = {pair: fit for pair, fit in synthetic.views.fits.items() if pair != (1, 2)}
    found = explained(synthetic.model, synthetic, ViewGraph(fits, {}))[1, 2]
    assert (found.inliers, found.contradicted) == (0, 0) and found.matches >= 100


def test_a_model_does_not_explain_matches_that_nobody_made(synthetic):
    rows = {pair: row[100:] for pair, row in synthetic.matches.matches.items()}
    matches = MatchGraph(synthetic.matches.images, synthetic.matches.keypoints, rows)
    found = explained_pairs(synthetic.model, Evidence(matches, ViewGraph({}, {}), None), 1.5)
    assert sum(pair.matches for pair in found.values()) < 0.3 * 20 * len(found)


def pairs(*counts):
    return {(0, k): PairSupport(count, count, 0) for k, count in enumerate(counts, start=1)}


def test_many_matches_of_one_pair_count_less_than_some_of_many():
    assert support(pairs(100)) == pytest.approx(50)
    assert support(pairs(1000)) == pytest.approx(1000 / 11)
    assert support(pairs(60, 60, 60)) > support(pairs(1000))
    assert support(pairs(60, 61)) > support(pairs(60, 60))
    assert support({}) == 0.0


def test_relative_poses_of_a_model_are_those_of_its_photos_with_the_matches_that_lie_right(synthetic):
    found = model_poses(synthetic.model, synthetic.matches, 1.5, 100)
    first, second = (synthetic.model.images[photo].cam_from_world().matrix() for photo in (1, 2))
    R = second[:, :3] @ first[:, :3].T
    t = second[:, 3] - R @ first[:, 3]
    assert list(found) == list(synthetic.matches.matches)
    np.testing.assert_allclose(found[1, 2].R, R, atol=1e-12)
    np.testing.assert_allclose(found[1, 2].t, t / np.linalg.norm(t), atol=1e-12)
    assert all(pose.inliers[:100].mean() > 0.98 and pose.inliers[100:].mean() < 0.5 for pose in found.values())


def test_pairs_of_a_model_that_share_little_have_no_relative_pose(synthetic):
    assert model_poses(synthetic.model, synthetic.matches, 1.5, 121) == {}


def fit(inliers, degeneracy=""):
    return EpipolarFit(np.eye(3), np.arange(50) < inliers, np.ones(50), 10, 0.3, degeneracy)


def photo_graph(count, blank=()):
    images = {key: MatchedImage(key, f"{key}.jpg", "one", 100, 100) for key in range(1, count + 1)}
    return MatchGraph(images, {key: np.ones((0 if key in blank else 9, 2)) for key in images}, {})


def graph_of_poses(dropped=None, poses=None):
    return PoseGraph(poses or {}, dropped or {}, ())


def test_every_photo_without_a_place_has_a_reason():
    views = ViewGraph({(1, 2): fit(40), (1, 3): fit(17), (2, 3): fit(20), (4, 5): fit(30), (2, 7): fit(25)}, {})

    reasons = unregistered_reasons({1, 2}, [(7, 8, 9)], photo_graph(10, blank=(10,)), views, graph_of_poses())

    assert reasons == {
        "3.jpg": "could not be placed: 20 inliers with the nearest placed photo",
        "4.jpg": "shares inliers only with photos that have no place either",
        "5.jpg": "shares inliers only with photos that have no place either",
        "6.jpg": "shares no scene with any other photo",
        "7.jpg": "belongs to another model, of 3 photos",
        "8.jpg": "belongs to another model, of 3 photos",
        "9.jpg": "belongs to another model, of 3 photos",
        "10.jpg": "no features were found in it",
    }


def test_a_photo_whose_nearest_pair_was_dropped_says_why():
    views = ViewGraph({(1, 2): fit(40), (1, 3): fit(17), (2, 3): fit(20), (2, 4): fit(30), (1, 5): fit(18)}, {})
    dropped = {(1, 3): BEHIND, (2, 3): CONTRADICTS, (1, 5): TOO_FEW}
    reasons = unregistered_reasons({1, 2}, [], photo_graph(5), views, graph_of_poses(dropped))
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
        not in unregistered_reasons({1, 2}, [], photo_graph(3), views, graph_of_poses({(2, 3): CONTRADICTS}))["3.jpg"]
    )
    assert (
        CONTRADICTS
        in unregistered_reasons({1, 2}, [], photo_graph(3), views, graph_of_poses({(1, 3): CONTRADICTS}))["3.jpg"]
    )


def row_of_photos(photos, reach):
    """Photos in a row, each paired with those within reach."""
    pairs = [(a, b) for a in range(photos) for b in range(a + 1, min(a + reach + 1, photos))]
    poses = {
        (a, b): RelativePose(np.eye(3), np.array([1.0, 0.0, 0.0]), np.arange(100) < 100 - (b - a), 5.0, 1.0)
        for a, b in pairs
    }
    return PoseGraph(poses, {}, (tuple(range(photos)),))


def test_all_pairs_of_a_small_set_are_mapped():
    graph = row_of_photos(100, 40)
    assert pairs_to_map(graph) is graph


def test_some_pairs_of_each_photo_of_a_large_set_are_mapped(monkeypatch):
    monkeypatch.setattr(module.MAPPING, "fully_mapped_photos", 90)
    graph = row_of_photos(100, 40)
    found = pairs_to_map(graph)
    counts = np.bincount(np.array(list(found.poses)).ravel(), minlength=100)
    assert counts.min() >= module.MAPPING.mapped_partners
    assert len(found.poses) < 0.5 * len(graph.poses)
    assert len(connected_groups(found.poses)) == 1
    assert max(b - a for a, b in found.poses) > 20
    assert found.groups == graph.groups


@pytest.mark.parametrize(("lost", "photos", "again"), [
    (0, 20, False), (1, 20, True), (1, 59, True), (2, 60, False), (3, 60, True), (49, 1000, False), (50, 1000, True),
])  # fmt: skip
def test_a_few_lost_photos_of_many_are_no_reason_to_map_again(lost, photos, again):
    assert are_many_unregistered(lost, photos) is again


def model(photos, points=500):
    return SimpleNamespace(num_reg_images=lambda: photos, num_points3D=lambda: points)


def attempt(photos, support, points=500, mapper="incremental"):
    """One whose pairs are worth so much in all: each of them with 100 matches counts as 50."""
    explained = {(0, k): PairSupport(100, 100, 0) for k in range(support // 50)}
    left = support % 50
    if left:
        explained[0, -1] = PairSupport(round(left / (1 - left / 100)), 0, 0)
    return Attempt(mapper, model(photos, points), explained, "")


@pytest.mark.slow
def test_the_attempt_that_explains_more_is_better_whatever_it_holds():
    more, most_photos = attempt(8, 1000, 100), attempt(10, 900, 9000)
    assert best_attempt([most_photos, more]) is more
    assert best_attempt([more, most_photos]) is more


@pytest.mark.slow
def test_of_equal_ones_the_one_with_more_photos_and_then_with_more_points():
    fewer, denser, more = attempt(9, 10050, 900), attempt(9, 10000, 901), attempt(10, 10000, 10)
    assert best_attempt([fewer, denser]) is denser
    assert best_attempt([fewer, denser, more]) is more
    assert (
        best_attempt([attempt(9, 10000, 10, "global"), attempt(9, 10000, 10)]).mapper == "global"
    )  # the first of twins


@pytest.mark.slow
def test_what_gave_no_model_is_never_better():
    nothing = NoModel("incremental", "")
    assert best_attempt([]) is None and best_attempt([nothing]) is None
    assert best_attempt([nothing, attempt(2, 0)]).photos == 2


COUNT = 10
ENOUGH = "it explains enough: {} % of the matches contradict it"


@pytest.fixture
def try_out(run, cameras):
    """What is tried on ten photos in a chain when mappers place so many photos.

    Seeds are the pairs (1, 2), (2, 3), ... in this order; `grown` says what becomes of each.
    """

    def make(
        grown, at_once=None, count=COUNT, points=500, contradicted=0, completed=0, settled=False, guess=False, **scene
    ):
        images = {key: MatchedImage(key, f"{key}.jpg", "one", 1024, 768) for key in range(1, count + 1)}
        rng = np.random.default_rng(0)
        keypoints = {key: rng.uniform((0, 0), (1024, 768), (400, 2)) for key in images}
        rows = np.tile(np.arange(400, dtype=np.uint32)[:, None], 2)
        poses = {
            (key, key + 1): RelativePose(np.eye(3), np.eye(3)[0], np.arange(400) < 400 - 20 * key, 20.0, 1.0)
            for key in range(1, count)
        }
        matches = MatchGraph(images, keypoints, dict.fromkeys(poses, rows))
        evidence = Evidence(
            matches, ViewGraph({}, {}), cameras(identifiable=not guess, method="guess" if guess else "zero-curves")
        )
        group = Group(tuple(images), evidence, PoseGraph(poses, {}, ()))
        calls = []

        def finish(mapper, result):
            calls.append(mapper)
            return result

        def grow(database, photo_dir, start, scratch, options, tick, token):
            if not isinstance(start, tuple):  # what another mapper made
                return model(completed, points) if completed else None
            placed = grown[start[0] - 1] if start[0] <= len(grown) else 0
            if isinstance(placed, Exception):
                raise placed
            return finish("incremental", model(placed, points) if placed else None)

        def place(photo_dir, names, scratch, seed, token):
            assert list(names) == [f"{key}.jpg" for key in images]
            if isinstance(at_once, Exception):
                raise at_once
            return finish("global", model(at_once, points) if at_once else None)

        explained = {(0, 1): PairSupport(100, 100, contradicted)}
        colmap = ColmapMappers(lambda *_: None, lambda *arguments: arguments[1], grow, place, lambda *_: explained)
        return map_group(group, run(**scene), lambda _: settled, colmap), calls

    return make


def placed(attempt):
    return 0 if isinstance(attempt, NoModel) else attempt.photos


def summary(found):
    return [(attempt.mapper, placed(attempt)) for attempt in found]


@pytest.mark.slow
def test_both_mappers_are_tried_and_one_good_model_is_enough(try_out):
    found, calls = try_out([9, 10], at_once=3)
    assert summary(found) == [("incremental", 9), ("global", 3)] and calls == ["incremental", "global"]
    assert [attempt.note for attempt in found] == ["from 1.jpg + 2.jpg: 9 photos", "all at once: 3 photos"]
    assert found[0].support == 50 and found[0].model.num_reg_images() == 9


@pytest.mark.slow
def test_the_global_mapper_can_be_switched_off(try_out):
    found, calls = try_out([9], at_once=10, without=["global-mapper"])
    assert summary(found) == [("incremental", 9)] and calls == ["incremental"]


@pytest.mark.slow
def test_a_flawless_model_makes_the_other_mapper_needless(try_out):
    found, calls = try_out([10], at_once=10)
    assert summary(found) == [("incremental", 10), ("global", 0)] and calls == ["incremental"]
    assert found[1].note == "all at once: not needed"


@pytest.mark.slow
@pytest.mark.parametrize(("guess", "contradicted", "flawless"), [
    (False, 10, True), (False, 11, False), (True, 1, True), (True, 2, False),
])  # fmt: skip
def test_a_model_of_all_photos_that_matches_contradict_is_not_flawless(try_out, guess, contradicted, flawless):
    found, _ = try_out([10], at_once=10, contradicted=contradicted, guess=guess)
    assert summary(found) == [("incremental", 10), ("global", 0 if flawless else 10)]


@pytest.mark.slow
def test_a_contradicted_model_that_says_enough_makes_the_other_one_needless(try_out):
    found, _ = try_out([10], at_once=10, contradicted=20, settled=True)
    assert summary(found) == [("incremental", 10), ("global", 0)]


@pytest.mark.slow
def test_why_a_model_was_taken_is_said():
    best, rival, nothing = attempt(10, 1000), attempt(9, 900), NoModel("global", "")
    contradicted = Attempt("global", model(10), {(0, 1): PairSupport(90, 100, 10)}, "")
    assert choice_reason(best, [best, NoModel("global", NOT_NEEDED)]) == ENOUGH.format("0.0")
    assert choice_reason(contradicted, [contradicted, nothing]) == "no other attempt gave a model"
    assert choice_reason(contradicted, [contradicted]) == ENOUGH.format("10.0")
    more = "it explains 2000 matches with 10 photos, the second best 1800 with 9"
    assert choice_reason(best, [rival, best]) == more


@pytest.mark.slow
def test_a_global_mapper_that_fails_leaves_the_other_model(try_out):
    found, _ = try_out([9], at_once=BackendError("bad day"))
    assert summary(found) == [("incremental", 9), ("global", 0)]
    assert found[1].note == "all at once: failed, bad day"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("grown", "at_once", "counts"),
    [
        ([10, 3], 2, [10, 0]),  # nothing better can come
        ([2, 3], 9, [2, 9, 0]),  # nor after the other mapper
        ([0, 0, 9], 0, [0, 0, 0, 9]),  # what fails is followed by the next best
        ([3, 3, 7, 2, 2], 3, [3, 3, 3, 7, 2, 2]),  # few photos, several times the same, are no reason to stop
        ([6, 9], 6, [6, 6]),  # more than half, twice the same: the others hang loose
        ([5, 4, 5, 9], 2, [5, 2, 4, 5]),  # also with another between them
        ([0, 0, 0, 0, 0, 10], 0, [0, 0, 0, 0, 0, 0]),  # no more seeds than allowed
    ],
)
def test_seeds_are_tried_until_one_grows(try_out, grown, at_once, counts):
    found, _ = try_out(grown, at_once, max_init_pairs=5)
    assert [placed(attempt) for attempt in found] == counts


@pytest.mark.slow
def test_one_mapper_alone(try_out):
    assert summary(try_out([5, 10], at_once=10, mapper="incremental")[0]) == [("incremental", 5), ("incremental", 10)]
    assert summary(try_out([5, 10], at_once=10, mapper="global")[0]) == [("global", 10)]


@pytest.mark.slow
def test_photos_that_the_global_mapper_left_out_get_a_second_chance(try_out):
    found, _ = try_out([3], at_once=8, completed=10, max_init_pairs=1)
    assert summary(found) == [("incremental", 3), ("global", 8), ("incremental", 10)]
    assert found[2].note == "missing photos added one by one: 10 photos"


@pytest.mark.slow
def test_of_two_photos_positions_have_no_scale_to_agree_on(try_out):
    assert summary(try_out([2], at_once=2, count=2)[0]) == [("incremental", 2)]
    assert summary(try_out([2], at_once=2, count=2, mapper="global")[0]) == [("incremental", 2)]


@pytest.mark.slow
def test_without_seeds_all_photos_can_still_be_placed_at_once(try_out):
    found, _ = try_out([10], at_once=10, min_seed_angle_deg=25.0)
    assert summary(found) == [("global", 10)]
    assert try_out([10], min_seed_angle_deg=25.0, mapper="incremental")[0] == []


@pytest.mark.slow
def test_a_model_with_too_few_points_is_none(try_out):
    found, _ = try_out([10], at_once=10, points=29)
    assert all(isinstance(attempt, NoModel) for attempt in found)
    assert [attempt.note for attempt in found[:2]] == ["from 1.jpg + 2.jpg: 10 photos", "all at once: 10 photos"]
    assert len(try_out([10], at_once=10, points=30)[0]) == 2


@pytest.mark.slow
def test_an_error_of_a_mapper_says_what_was_being_done(try_out):
    with pytest.raises(BackendError, match="mapping photos: out of luck"):
        try_out([ValueError("out of luck")], at_once=2)
