import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.geometry.epipolar import cross_matrix, eight_point
from sfm_app.geometry.essential import relative_pose
from sfm_app.geometry.triangulation import triangulate, triangulation_angle_deg
from sfm_app.posegraph.pair_pose import depths, estimate_pose, is_in_front, ray_angles_deg, rotation_residuals
from sfm_app.types import EpipolarFit


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

    first, second = depths(views.rays, views.R, views.t)

    np.testing.assert_allclose(first, X[:, 2], rtol=1e-6)
    np.testing.assert_allclose(second, (X @ views.R.T + views.t)[:, 2], rtol=1e-6)
    angles = triangulation_angle_deg(X, np.zeros(3), -views.R.T @ views.t)
    np.testing.assert_allclose(ray_angles_deg(views.rays, views.R), angles, atol=1e-5)


def test_the_points_before_both_cameras_are_those_that_triangulation_finds_there(two_views):
    views = two_views(noise_px=0.0)
    rays = views.rays.copy()
    rays[:60] = rays[:60][:, [2, 3, 0, 1]]  # matches the wrong way round

    front = is_in_front(rays, views.R, views.t)
    expected = relative_pose(cross_matrix(views.t) @ views.R, rays[:, :2], rays[:, 2:])[3]

    assert front[60:].all()
    assert not is_in_front(views.rays, views.R, -views.t).any()
    assert np.array_equal(front[60:], expected[60:])


def test_a_turn_explains_matches_without_parallax_and_no_others(two_views):
    tilted = Rotation.from_euler("y", 8.0, degrees=True).as_matrix()
    turn, box = two_views(scene="turn"), two_views(false=0)

    assert np.median(rotation_residuals(turn.rays, turn.focals, tilted @ turn.R)) < 0.5
    assert np.median(rotation_residuals(box.rays, box.focals, box.R)) > 5.0
    mixed = np.vstack([turn.rays, two_views(3).rays[:80]])
    distances = rotation_residuals(mixed, turn.focals, turn.R)
    assert np.median(distances[:200]) < 0.6 and np.median(distances[200:]) > 5.0
