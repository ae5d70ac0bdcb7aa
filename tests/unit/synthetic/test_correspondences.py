import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.errors import ConfigError
from sfm_app.synthetic.correspondences import PairOptions, TrackOptions, make_pair, make_tracks

SEEDS = st.integers(0, 2**32 - 1)


def homogeneous(x):
    return np.column_stack([x, np.ones(len(x))])


def epipolar_distance(F, x1, x2):
    lines = homogeneous(x1) @ F.T
    return np.abs(np.sum(homogeneous(x2) * lines, axis=1)) / np.hypot(lines[:, 0], lines[:, 1])


def depths(pair):
    """Depth of every point in both cameras, from the exact points and the true cameras."""
    d1 = homogeneous(pair.exact_x1) @ np.linalg.inv(pair.K1).T @ pair.R.T
    d2 = homogeneous(pair.exact_x2) @ np.linalg.inv(pair.K2).T
    pencils = [np.column_stack([-a, b]) for a, b in zip(d1, d2, strict=True)]
    return np.array([np.linalg.lstsq(pencil, pair.t, rcond=None)[0] for pencil in pencils])


@given(seed=SEEDS)
@settings(max_examples=25)
def test_exact_points_satisfy_the_true_epipolar_geometry(seed):
    pair = make_pair(PairOptions(points=50), seed)
    assert epipolar_distance(pair.F, pair.exact_x1, pair.exact_x2).max() < 1e-8
    assert np.linalg.norm(pair.F) == pytest.approx(1.0) and np.linalg.svd(pair.F, compute_uv=False)[2] < 1e-12
    assert depths(pair).min() > 0, "every point lies in front of both cameras"
    for x in (pair.exact_x1, pair.exact_x2):
        assert x.min() >= 0 and x.max() <= 512


@pytest.mark.parametrize("seed", range(5))
def test_points_behind_a_camera_are_not_matches(seed):
    # cameras far apart and turned anywhere: many points project into image 2 from behind
    wide = PairOptions(points=100, max_rotation_deg=180.0, max_baseline=3.0)
    assert depths(make_pair(wide, seed)).min() > 0


@pytest.mark.parametrize("sigma_px", [0.3, 1.0, 2.0])
def test_noise_is_the_injected_noise(sigma_px):
    pair = make_pair(PairOptions(sigma_px=sigma_px, outliers=0.25), seed=4)
    for noise in (pair.x1 - pair.exact_x1, (pair.x2 - pair.exact_x2)[pair.is_inlier]):
        assert 0.93 * sigma_px < noise.std() < 1.07 * sigma_px and abs(noise.mean()) < 0.1 * sigma_px


@pytest.mark.parametrize("outliers", [0.0, 0.1, 0.5, 0.7])
def test_outliers_are_as_many_and_as_far_off_as_asked(outliers):
    pair = make_pair(PairOptions(sigma_px=0.0, outliers=outliers, outlier_range_px=100.0), seed=1)
    moved = pair.x2 - pair.exact_x2
    assert np.count_nonzero(~pair.is_inlier) == round(1200 * outliers)
    assert np.array_equal(np.any(moved != 0, axis=1), ~pair.is_inlier)
    assert np.abs(moved).max(initial=0.0) <= 100.0
    if outliers:
        assert 52 < moved[~pair.is_inlier].std() < 63, "uniform in +-100 has a deviation of 57.7"
        assert np.any(~pair.is_inlier[:600]) and np.any(~pair.is_inlier[600:]), "outliers stand at random rows"


def test_one_seed_one_pair():
    options = PairOptions(points=40, outliers=0.3)
    first, again, other = make_pair(options, 7), make_pair(options, 7), make_pair(options, 8)
    assert first.x2.tobytes() == again.x2.tobytes() and first.F.tobytes() == again.F.tobytes()
    assert first.x1.tobytes() != other.x1.tobytes()
    thesis = make_pair(PairOptions(), seed=0)
    assert thesis.x1.shape == (1200, 2) and thesis.K.tolist() == [[700, 0, 256], [0, 700, 256], [0, 0, 1]]


def test_wrong_and_impossible_options_are_named():
    with pytest.raises(ConfigError, match=r"points, outliers, sigma_px"):
        PairOptions(points=7, outliers=1.0, sigma_px=float("nan"))
    with pytest.raises(ConfigError, match=r"corrupted_pairs, aspect"):
        TrackOptions(corrupted_pairs=11, aspect=(1.2, 0.8))
    with pytest.raises(ConfigError, match="no random camera pair"):
        make_pair(PairOptions(focal_px=1e6), seed=0, max_setups=20)
    with pytest.raises(ConfigError, match="no random cameras"):
        make_tracks(TrackOptions(focal_px=(1e6, 1e6)), seed=0, max_setups=20)


def singular_ratio(F, K):
    s = np.linalg.svd(K.T @ F @ K, compute_uv=False)
    return s[1] / s[0]


@given(seed=SEEDS)
@settings(max_examples=15)
def test_the_true_camera_makes_every_fundamental_matrix_essential(seed):
    tracks = make_tracks(TrackOptions(points=20), seed)
    fx, fy, cx, cy = tracks.K[0][[0, 1, 0, 1], [0, 1, 2, 2]]
    assert len(tracks.pairs) == 10 and tracks.corrupted == () and tracks.size == (512, 512)
    assert all(singular_ratio(F, tracks.K[0]) > 1 - 1e-9 for F in tracks.F)
    assert 500 <= fx <= 1000 and 0.8 <= fy / fx <= 1.2 and 0.4 <= cx / 512 <= 0.6 and 0.4 <= cy / 512 <= 0.6


def test_tracks_are_projections_of_their_points():
    tracks = make_tracks(TrackOptions(sigma_px=0.0), seed=2)
    for K, R, t, x in zip(tracks.K, tracks.R, tracks.t, tracks.x, strict=True):
        h = (tracks.X @ R.T + t) @ K.T
        assert h[:, 2].min() > 0 and np.allclose(h[:, :2] / h[:, 2:], x)
        assert x.min() >= 0 and x.max() <= 512
    pair = tracks.pairs[1, 3]
    assert np.array_equal(pair.x1, tracks.x[1]) and np.array_equal(pair.x2, tracks.x[3])
    assert epipolar_distance(pair.F, pair.x1, pair.x2).max() < 1e-8


def test_only_the_corrupted_pairs_hold_outliers():
    tracks = make_tracks(TrackOptions(corrupted_pairs=2, outliers=0.4), seed=5)
    assert len(tracks.corrupted) == 2
    for name, pair in tracks.pairs.items():
        assert np.count_nonzero(~pair.is_inlier) == (80 if name in tracks.corrupted else 0)


def test_another_focal_length_spoils_the_pairs_of_the_last_camera_only():
    tracks = make_tracks(TrackOptions(other_focal=1.5), seed=6)
    assert np.allclose(tracks.K[-1, [0, 1], [0, 1]], 1.5 * tracks.K[0, [0, 1], [0, 1]])
    for (_, j), pair in tracks.pairs.items():
        off = 1 - singular_ratio(pair.F, tracks.K[0])
        assert off > 1e-3 if j == 4 else off < 1e-9
        assert singular_ratio(pair.F, pair.K1) == pytest.approx(singular_ratio(pair.F, tracks.K[0]))
        s = np.linalg.svd(pair.K2.T @ pair.F @ pair.K1, compute_uv=False)
        assert s[1] / s[0] == pytest.approx(1.0), "with its own K the pair is perfect"


@pytest.mark.parametrize("seed", range(3))
def test_the_setups_are_those_of_the_thesis(seed):
    tracks = make_tracks(TrackOptions(), seed)
    axes = tracks.R[:, 2]
    centers = -np.einsum("cij,ci->cj", tracks.R, tracks.t)
    assert tracks.x.shape == (5, 200, 2) and len(tracks.X) == 200
    assert np.degrees(np.arccos(axes @ [0, 0, 1])).max() <= 30 and np.linalg.norm(centers, axis=1).max() <= 0.6
    assert np.ptp(centers, axis=0).min() > 0.05, "they moved in every direction"
    assert len({make_tracks(TrackOptions(points=8), n).K[0, 0, 0] for n in range(4)}) == 4, "each setup has its own K"


@pytest.mark.parametrize("change", [{"outliers": 0.7}, {"corrupted_pairs": 5}, {"sigma_px": 2.0}])
def test_a_seed_keeps_its_setup_whatever_corrupts_it(change):
    one, other = make_tracks(TrackOptions(), 3), make_tracks(TrackOptions(**change), 3)
    assert np.array_equal(one.X, other.X) and np.array_equal(one.K, other.K) and np.array_equal(one.R, other.R)
