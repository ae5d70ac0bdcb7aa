import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.camera.bearings import project
from sfm_app.camera.models import camera_matrix
from sfm_app.geometry.epipolar import (
    cross_matrix,
    decompose_essential,
    depths,
    eight_point,
    nearest_essential,
    rotation_residuals,
    sampson_distance,
    triangulate,
    triangulation_angle_deg,
)
from sfm_app.geometry.poses import is_in_front, pose_distances, ray_angles_deg, retract
from sfm_app.posegraph.pair_pose import (
    OPTIONS,
    Pair,
    estimate_pose,
    planar_starts,
    points_ahead,
    refine_pose,
    turned_starts,
)
from sfm_app.types import Calibration, EpipolarFit


def fit_of(views, F=None):
    """What an estimator gives: F of the right matches, and they alone as its inliers."""
    inliers = np.arange(len(views.x1)) < views.right
    F = eight_point(views.x1[inliers], views.x2[inliers]) if F is None else F
    return EpipolarFit(F, inliers, np.ones(len(inliers)), 10, 0.3)


@pytest.mark.parametrize(
    ("scene", "kind"), [("box", "calibrated"), ("wall", "planar"), ("turn", "rotation")]
)  # fmt: skip
@pytest.mark.parametrize("seed", range(3))
def test_a_pair_is_called_what_its_inliers_are_of(two_views, scene, kind, seed):
    views = two_views(seed, scene=scene)
    # F of a plane or a turn is as good as any that holds it
    pose = estimate_pose(views.pair(), fit_of(views, views.F))
    assert pose.kind == kind
    assert views.errors_deg(pose.R, pose.t)[0] < 0.3
    assert not pose.guided


def test_some_points_off_the_wall_make_a_pair_that_is_not_planar(two_views):
    wall, box = two_views(scene="wall"), two_views(1)
    share = {}
    for off in (4, 40):
        both = type(wall)(
            *(np.vstack([a[off:], b[:off]]) for a, b in ((wall.x1, box.x1), (wall.x2, box.x2))), 200, wall.R, wall.t
        )
        share[off] = estimate_pose(both.pair(), fit_of(both, both.F)).kind
    assert share == {4: "planar", 40: "calibrated"}


def test_the_pose_is_right_and_false_matches_are_no_inliers(two_views):
    views = two_views(false=100)
    pose = estimate_pose(views.pair(), fit_of(views))
    assert 0.001 < views.errors_deg(pose.R, pose.t).max() < 0.3
    assert pose.inliers[: views.right].mean() > 0.99 and pose.inliers[views.right :].mean() < 0.1
    assert pose.in_front > 0.98
    assert pose.angle_deg == pytest.approx(9.0, abs=2.0)
    assert np.linalg.norm(pose.t) == pytest.approx(1.0)


def test_where_a_camera_is_a_guess_the_inliers_of_F_stay(two_views):
    views, guess = two_views(false=20), two_views.camera(method="guess", identifiable=False)
    pose = estimate_pose(views.pair((two_views.camera(), guess)), fit_of(views))
    assert pose.kind == "uncalibrated"
    assert np.array_equal(pose.inliers, fit_of(views).inliers)


def test_a_claimed_camera_is_trusted(two_views):
    claimed = two_views.camera(method="claim", identifiable=False)
    assert two_views().pair((claimed, claimed)).trusted
    assert estimate_pose(two_views().pair((claimed, claimed)), fit_of(two_views())).kind == "calibrated"


def test_too_few_matches_have_no_pose(two_views):
    views = two_views(right=7, false=0)
    assert estimate_pose(views.pair(), fit_of(views, views.F)) is None


def test_the_pose_is_right_only_when_the_camera_knows_its_lens(two_views):
    views = two_views(radial=-0.2)
    bent, straight = (views.pair([two_views.camera(radial)] * 2) for radial in (0.0, -0.2))
    errors = [views.errors_deg(*((p := estimate_pose(pair, fit_of(views))).R, p.t)).max() for pair in (bent, straight)]
    assert 0.001 < errors[1] < 0.3
    assert errors[0] > 4 * errors[1] and errors[0] > 1.0


@pytest.mark.parametrize("seed", range(4))
def test_a_pose_starts_from_rays_where_a_lens_has_bent_the_photos(two_views, seed):
    """F knows no lens, and is off by degrees where there is one."""
    views = two_views(seed, radial=-0.2)
    pair, bent = views.pair([two_views.camera(-0.2)] * 2), views.pair()
    assert views.errors_deg(*pair.initial_pose(fit_of(views))).max() < 0.7
    assert views.errors_deg(*bent.initial_pose(fit_of(views))).max() > 1.5


def test_depths_are_those_of_triangulated_points(two_views):
    views = two_views(noise_px=0.0)
    x1, x2 = views.rays[:, :2], views.rays[:, 2:]
    X = triangulate(np.eye(3, 4), np.column_stack([views.R, views.t]), x1, x2)
    first, second = depths(views.lines, views.R, views.t)
    np.testing.assert_allclose(first, X[:, 2], rtol=1e-6)
    np.testing.assert_allclose(second, (X @ views.R.T + views.t)[:, 2], rtol=1e-6)
    angles = triangulation_angle_deg(X, np.zeros(3), -views.R.T @ views.t)
    np.testing.assert_allclose(ray_angles_deg(views.lines, views.R), angles, atol=1e-5)


def test_the_points_before_both_cameras_are_those_that_triangulation_finds_there(two_views):
    views = two_views(noise_px=0.0)
    lines, rays = views.lines, views.rays
    lines[:60] = np.roll(lines[:60], 9, axis=1)  # matches the wrong way round
    rays[:60] = rays[:60][:, [2, 3, 0, 1]]
    front = is_in_front(lines, views.R, views.t)
    X = triangulate(np.eye(3, 4), np.column_stack([views.R, views.t]), rays[:, :2], rays[:, 2:])
    expected = (X[:, 2] > 0) & ((X @ views.R.T + views.t)[:, 2] > 0)
    assert front[60:].all()
    assert not is_in_front(views.lines, views.R, -views.t).any()
    assert np.array_equal(front[60:], expected[60:])


def test_a_turn_explains_matches_without_parallax_and_no_others(two_views):
    tilted = Rotation.from_euler("y", 8.0, degrees=True).as_matrix()
    turn, box = two_views(scene="turn"), two_views(false=0)
    assert np.median(rotation_residuals(turn.lines, tilted @ turn.R)) < 0.5
    assert np.median(rotation_residuals(box.lines, box.R)) > 5.0
    mixed = np.vstack([turn.lines, two_views(3).lines[:80]])
    distances = rotation_residuals(mixed, turn.R)
    assert np.median(distances[:200]) < 0.6 and np.median(distances[200:]) > 5.0


WIDE = {
    "fisheye": Calibration(np.array([[300.0, 0, 400], [0, 300, 300], [0, 0, 1]]), 800, 600, "lens", True,
                           projection="fisheye", distortion=(0.05,)),
    "equirectangular": Calibration(np.eye(3), 800, 400, "panorama", True, projection="equirectangular"),
}  # fmt: skip


@pytest.mark.parametrize("name", WIDE)
@pytest.mark.parametrize("seed", range(3))
def test_a_pose_is_found_through_a_wide_lens(two_views, name, seed):
    """Points all round where a panorama sees them; a tenth of the matches is wrong."""
    rng, lens, truth = np.random.default_rng([seed, 5]), WIDE[name], two_views()
    X = rng.normal(size=(200, 3))
    X *= rng.uniform(3.0, 8.0, (200, 1)) / np.linalg.norm(X, axis=1, keepdims=True)
    X[:, 2] = X[:, 2] if name == "equirectangular" else np.abs(X[:, 2]) + 2.0
    x1, x2 = (project(Y, lens) + rng.normal(0.0, 0.3, (200, 2)) for Y in (X, X @ truth.R.T + truth.t))
    x2[:20] = rng.uniform([100, 50], [700, 350], (20, 2))
    inliers = np.arange(200) >= 20
    fit = EpipolarFit(np.eye(3), inliers, np.ones(200), 1, 0.3)

    pose = estimate_pose(Pair((x1, x2), (lens, lens), 1.5), fit)

    assert 0.0 < truth.errors_deg(pose.R, pose.t).max() < 0.5
    assert pose.kind == "calibrated" and pose.in_front > 0.98
    assert np.count_nonzero(pose.inliers[:20]) < 6 and pose.inliers[20:].mean() > 0.95


def test_panoramas_that_face_away_from_each_other_have_a_pose(two_views):
    """What lies before the one lies behind the other, so that no plane z = 1 shows both."""
    rng, lens, truth = np.random.default_rng(4), WIDE["equirectangular"], two_views()
    X = rng.uniform([-3.0, -2.0, 4.0], [3.0, 2.0, 8.0], (150, 3))
    turn = np.diag([-1.0, 1.0, -1.0])
    R, t = turn @ truth.R, turn @ truth.t
    x1, x2 = (project(Y, lens) + rng.normal(0.0, 0.3, (150, 2)) for Y in (X, X @ R.T + t))

    pose = estimate_pose(
        Pair((x1, x2), (lens, lens), 1.5), EpipolarFit(np.eye(3), np.full(150, True), np.ones(150), 1, 0.3)
    )

    turned = np.degrees(np.arccos(np.clip(0.5 * (np.trace(pose.R @ R.T) - 1.0), -1.0, 1.0)))
    assert 0.0 < turned < 0.5 and t @ pose.t > 0.99 * np.linalg.norm(t)


def started(views, used):
    """The pose that eight points give, of the four the one nearest to the truth."""
    E = eight_point(views.rays[used, :2], views.rays[used, 2:])
    return min(decompose_essential(nearest_essential(E)), key=lambda pose: views.errors_deg(*pose).sum())


def test_distances_are_those_of_sampson_in_pixels(two_views):
    views = two_views(false=50)
    found = pose_distances(views.lines, views.R, views.t)
    np.testing.assert_allclose(found, sampson_distance(views.F, views.x1, views.x2), rtol=1e-6)


def test_the_pose_of_exact_matches_is_exact(two_views):
    views = two_views(noise_px=0.0)
    start = started(two_views(noise_px=1.0), np.arange(30))
    assert views.errors_deg(*start).max() > 0.1
    R, t = refine_pose(views.lines, start[0], 7.0 * start[1])
    assert views.errors_deg(R, t).max() < 1e-5
    assert np.linalg.norm(t) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_false_matches_and_a_second_structure_hardly_move_the_pose(two_views):
    """Of 300 matches a quarter are wrong by chance and a tenth fit another pose."""
    starts, ends, clean = [], [], []
    for seed in range(8):
        views = two_views(seed, right=195, second=30, false=75)
        start = started(views, np.arange(40))
        starts.append(views.errors_deg(*start))
        ends.append(views.errors_deg(*refine_pose(views.lines, *start)))
        clean.append(views.errors_deg(*refine_pose(views.lines[:195], *start)))
    starts, ends, clean = (np.median(errors, axis=0) for errors in (starts, ends, clean))

    assert np.all(ends < [0.05, 0.2]) and np.all(ends > [0.001, 0.005])
    assert np.all(ends < 0.5 * starts)
    assert np.all(ends < 1.5 * clean)


def test_no_pose_nearby_explains_the_matches_better(two_views):
    """The end is a minimum of Cauchy's loss at its last, narrow scale."""
    views, rng = two_views(false=60, second=20), np.random.default_rng(0)
    R, t = refine_pose(views.lines, *started(views, np.arange(40)))

    def cost(pose):
        squared = pose_distances(views.lines, pose[:9].reshape(3, 3), pose[9:]) ** 2
        return np.log1p(squared / OPTIONS.sigmas_px[-1] ** 2).sum()

    end = np.concatenate([R.ravel(), t])
    nearby = [cost(retract(end, 2e-4 * rng.normal(size=5))) for _ in range(100)]
    assert cost(end) < min(nearby) + 1e-4
    assert cost(end) < 0.98 * cost(np.concatenate([np.ravel(part) for part in started(views, np.arange(40))]))


def test_matches_that_say_nothing_leave_the_pose_as_it_is(two_views):
    views = two_views()
    R, t = refine_pose(np.empty((0, 18)), views.R, views.t)
    np.testing.assert_allclose(R, views.R)
    np.testing.assert_allclose(t, views.t)


K_LONG = camera_matrix(3300.0, 3300.0, 320.0, 240.0)
CAMERA = Calibration(K_LONG, 640, 480, "zero-curves", True)


def orbit_pair(seed, turn_deg, points=150, noise_px=0.3, roll_deg=0.0):
    """A thing of unit size seen from 9 units away, before and after a turn about it."""
    rng = np.random.default_rng([seed, 7])
    X = rng.uniform(-0.5, 0.5, (points, 3))
    turn = Rotation.from_euler("zyx", [roll_deg, turn_deg, 3.0], degrees=True).as_matrix()
    away = np.array([0.0, 0.0, 9.0])
    views = []
    for R in (np.eye(3), turn):
        x = (X @ R.T + away) @ K_LONG.T
        views.append(x[:, :2] / x[:, 2:] + rng.normal(0.0, noise_px, (points, 2)))
    t = away - turn @ away
    F = eight_point(*views)
    return Pair(tuple(views), (CAMERA, CAMERA), 1.5), F, turn, t / np.linalg.norm(t)


def pose_errors_deg(R, t, true_R, true_t):
    return np.degrees(Rotation.from_matrix(R @ true_R.T).magnitude()), np.degrees(np.arccos(np.clip(t @ true_t, -1, 1)))


@pytest.mark.parametrize("turn_deg", [-40.0, -20.0, 10.0, 25.0, 60.0])
@pytest.mark.parametrize("roll_deg", [0.0, 100.0])
def test_the_nearest_of_the_starts_is_near(turn_deg, roll_deg):
    pair, F, R, t = orbit_pair(1, turn_deg, noise_px=0.0, roll_deg=roll_deg)
    found = [pose_errors_deg(*start, R, t) for start in turned_starts(points_ahead(pair.lines), K_LONG.T @ F @ K_LONG)]
    assert len(found) == len(OPTIONS.turns_deg)
    nearest = min(found)
    gaps = np.diff(sorted(OPTIONS.turns_deg))
    assert 0.0 < nearest[0] < 0.5 * gaps.max() + 3.0
    assert nearest[1] < 12.0
    assert max(found)[0] > 40.0


@pytest.mark.parametrize("turned_deg", [-60.0, 90.0])
@pytest.mark.parametrize("seed", range(4))
def test_where_F_turns_the_camera_elsewhere_the_pair_is_posed_all_the_same(seed, turned_deg):
    """Through a long lens all turns about the same axis have nearly the same epipolar lines."""
    pair, _, R, t = orbit_pair(seed, 23.0)
    wrong = Rotation.from_euler("zyx", [0.0, turned_deg, np.copysign(3.0, turned_deg)], degrees=True).as_matrix()
    E = cross_matrix(np.array([0.0, 0.0, 9.0]) - wrong @ [0.0, 0.0, 9.0]) @ wrong
    fit = EpipolarFit(np.linalg.inv(K_LONG).T @ E @ np.linalg.inv(K_LONG), np.ones(150, bool), np.ones(150), 10, 0.5)

    alone = refine_pose(pair.lines, *pair.initial_pose(fit))
    pose = estimate_pose(pair, fit)

    assert pose_errors_deg(*alone, R, t)[0] > 20.0
    assert 0.0 < pose_errors_deg(pose.R, pose.t, R, t)[0] < 2.0
    assert pose.in_front == 1.0


@pytest.mark.parametrize("seed", range(3))
def test_one_of_the_poses_that_a_plane_allows_is_the_right_one(two_views, seed):
    views = two_views(seed, scene="wall")
    found = [views.errors_deg(*start).max() for start in planar_starts(views.rays)]
    assert 2 <= len(found) <= 4
    assert 0.0 < min(found) < 1.5
    assert max(found) > 10.0


def test_too_few_matches_and_those_on_a_line_have_no_plane():
    line = np.column_stack([np.linspace(0, 1, 20)] * 4)
    assert list(planar_starts(line[:7])) == []
    assert all(np.isfinite(R).all() and np.isfinite(t).all() for R, t in planar_starts(line))


def test_matches_without_extent_give_no_starts():
    used = np.zeros((5, 4))
    assert list(turned_starts(used, np.zeros((3, 3)))) == []
    assert list(turned_starts(used, cross_matrix(np.array([0.0, 0.0, 1.0])))) == []
