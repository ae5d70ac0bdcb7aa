import numpy as np

from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.selfcal.pairs import undistort_pairs
from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
from sfm_app.types import Calibration, CameraPairs

K1 = -0.15


def seen_through_lens(x, K):
    rays = (x - K[:2, 2]) / K[[0, 1], [0, 1]]
    return x + K1 * np.sum(rays**2, axis=1, keepdims=True) * (x - K[:2, 2])


def test_without_its_lens_a_camera_has_the_true_fundamental_matrices():
    tracks = make_tracks(TrackOptions(cameras=4, sigma_px=0.0), seed=2)
    K, views = tracks.K[0], list(tracks.pairs.values())
    bent = [np.hstack([seen_through_lens(view.x1, K), seen_through_lens(view.x2, K)]) for view in views]
    pairs = CameraPairs(tracks.F, np.ones(len(views)), tracks.size, tuple(tracks.pairs), tuple(bent))
    camera = Calibration(K, *tracks.size, "zero-curves", True, radial=K1)

    found = undistort_pairs(pairs, camera)

    for F, view, straight in zip(found.Fs, views, found.inliers, strict=True):
        np.testing.assert_allclose(straight, np.hstack([view.exact_x1, view.exact_x2]), atol=1e-6)
        assert sampson_distance(F, view.exact_x1, view.exact_x2).max() < 1e-4
    assert np.max(np.abs(bent[0] - found.inliers[0])) > 3


def test_without_a_lens_or_matches_nothing_changes():
    pairs = CameraPairs.from_Fs(np.eye(3)[None], (640, 480))
    bent = Calibration(np.eye(3), 640, 480, "zero-curves", True, radial=K1)

    assert undistort_pairs(pairs, bent) is pairs
