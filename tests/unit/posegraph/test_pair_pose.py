import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.camera.bearings import project
from sfm_app.geometry.epipolar import (
    cross_matrix,
    depths,
    eight_point,
    relative_pose,
    rotation_residuals,
    triangulate,
    triangulation_angle_deg,
)
from sfm_app.posegraph.pair_pose import Pair, estimate_pose, is_in_front, ray_angles_deg
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


def test_a_focal_from_exif_is_trusted(two_views):
    claimed = two_views.camera(method="exif", identifiable=False)

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
    expected = relative_pose(cross_matrix(views.t) @ views.R, rays[:, :2], rays[:, 2:])[3]

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
                           projection="fisheye", fisheye=(0.05, 0.0, 0.0, 0.0)),
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
