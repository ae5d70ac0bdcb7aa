"""The figure of a calibration: votes, lens and residuals."""

import re
from dataclasses import replace

import numpy as np
import pytest

from sfm_app.camera.projection import Fisheye
from sfm_app.errors import ConfigError
from sfm_app.estimation.fitting import to_calibration
from sfm_app.report.figures import (
    OPTIONS,
    Panel,
    center_plane,
    check_figure,
    draw_calibration,
    epipolar_residuals,
    focal_plane,
    lens_curve,
    residual_grid,
    vote_shares,
)
from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.wide_lens import LensEstimate
from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
from sfm_app.types import Calibration, CameraPairs

SPREAD = {"fx": 4.0, "fy": 3.0, "cx": 6.0, "cy": 5.0}


@pytest.fixture(scope="module")
def panel():
    """A camera that is known exactly, and exact fundamental matrices."""
    tracks = make_tracks(TrackOptions(cameras=5, sigma_px=0.0), seed=3)
    camera = Calibration(tracks.K[0], *tracks.size, "zero-curves", True, spread=SPREAD)
    return Panel("one", camera, CameraPairs.from_Fs(tracks.F, tracks.size))


def prepared(panel):
    width, height = panel.pairs.size
    return prepare(panel.pairs, unit_px=float(max(width, height)), origin_px=(width / 2, height / 2))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "start"), [("a.png", b"\x89PNG"), ("b.SVG", b"<?xml"), ("c.pdf", b"%PDF")])
def test_the_suffix_names_the_format_and_the_bytes_do_not_change(panel, tmp_path, name, start):
    places = [tmp_path / folder / name for folder in ("one", "two")]
    for place in places:
        draw_calibration(place, [panel])
    first, second = (place.read_bytes() for place in places)
    assert first.startswith(start)
    assert first == second


@pytest.mark.parametrize("name", ["figure.jpg", "figure", "png"])
def test_other_suffixes_are_refused_by_name(tmp_path, name):
    with pytest.raises(ConfigError, match=re.escape(f"figure {name}: cannot write")) as caught:
        check_figure(tmp_path / name)
    assert ".png" in caught.value.hint


@pytest.mark.parametrize("make", [focal_plane, center_plane])
def test_votes_are_unanimous_at_the_camera_and_nowhere_higher(panel, make):
    plane = make(panel.camera, prepared(panel))
    left, right, bottom, top = plane.extent

    shares = vote_shares(plane, panel.camera, prepared(panel))

    row, column = np.unravel_index(np.argmax(shares), shares.shape)
    cells = len(shares)
    peak = left + (right - left) * (column + 0.5) / cells, bottom + (top - bottom) * (row + 0.5) / cells
    assert abs(peak[0] - plane.estimate[0]) <= abs(right - left) / cells
    assert abs(peak[1] - plane.estimate[1]) <= abs(top - bottom) / cells
    assert 0.8 < shares.max() <= 1.0


@pytest.mark.parametrize("make", [focal_plane, center_plane])
def test_curves_pass_through_the_camera(panel, make):
    plane = make(panel.camera, prepared(panel))
    there = plane.curves(np.array([plane.estimate[0]]))[:, 0]
    # a pair may have a second real root there, and the curve may be the other one
    assert np.mean(np.abs(there - plane.estimate[1]) < 0.5) >= 0.7


def test_a_guess_is_drawn_without_pairs(panel, tmp_path):
    guess = replace(panel.camera, identifiable=False, method="guess", reason="no pairs", spread={})
    nothing = CameraPairs.from_Fs(np.zeros((0, 3, 3)), panel.pairs.size)
    draw_calibration(tmp_path / "guess.svg", [Panel("one", guess, nothing)])
    assert "no pair of photos is from this camera alone" in (tmp_path / "guess.svg").read_text()


@pytest.mark.slow
def test_of_many_cameras_the_first_are_drawn(panel, tmp_path):
    count = OPTIONS.most_cameras + 1
    draw_calibration(tmp_path / "many.svg", [panel._replace(name=f"camera-{k}") for k in range(count)])
    text = (tmp_path / "many.svg").read_text()
    assert f"camera-{OPTIONS.most_cameras - 1}, one of {count}" in text
    assert f"camera-{OPTIONS.most_cameras}," not in text


SAYS = {
    "perspective": ["ideal pinhole", "square pixels", "votes"],
    "fisheye": ["ideal equidistant lens", "stereographic", "a fisheye that sees 141 degrees"],
    "equirectangular": ["equirectangular", "360-degree panoramas, 1000 x 500 px"],
}


@pytest.mark.slow
def test_every_projection_is_drawn_with_what_it_has(camera, make_pairs, tmp_path):
    pairs = make_pairs(camera)
    draw_calibration(tmp_path / "figure.svg", [Panel("one", camera, pairs)])
    text = "".join(re.findall(r"<!-- (.*?) -->", (tmp_path / "figure.svg").read_text()))
    assert all(one in text for one in SAYS[camera.projection])
    assert ("square pixels" in text) == (camera.projection == "perspective")
    assert f"Residuals of {sum(map(len, pairs.inliers))} matches" in text


def test_the_curve_is_compared_with_the_ideal_lens_of_the_same_focal(camera):
    curve = lens_curve(camera)

    assert curve.radius_px[0] == curve.ideal_px[0] == 0.0
    if camera.projection == "fisheye":
        theta = np.radians(curve.theta_deg)
        assert curve.radius_px - curve.ideal_px == pytest.approx(420.0 * -0.02 * theta**3)
    else:
        assert curve.radius_px == pytest.approx(curve.ideal_px)
    assert curve.theta_deg[-1] == pytest.approx(
        {"perspective": np.degrees(np.arctan(np.hypot(510, 410) / 800)), "equirectangular": 180.0}.get(
            camera.projection, curve.theta_deg[-1]
        )
    )


def test_the_band_of_a_found_lens_is_that_of_its_covariance():
    lens = Fisheye(480.0 / np.radians(60.0), 0.0, (480.0, 320.0))
    covariance = np.diag([1e-3, 0.01, 0.5, 0.5]) ** 2
    estimate = LensEstimate(lens, tuple(map(tuple, covariance.tolist())), 0.9, 0.4, 12, (960, 640))
    curve = lens_curve(to_calibration(estimate, (960, 640)))
    true = estimate.radius_deviation_px(np.radians(curve.theta_deg))
    assert np.abs(curve.deviation_px - true).max() < 0.05 * true.max()
    assert curve.deviation_px[-1] == pytest.approx(true[-1], rel=0.01)


def test_the_residuals_are_the_noise_across_the_epipolar_lines(camera, make_pairs):
    pairs = make_pairs(camera, noise_px=0.25)
    x, distances = epipolar_residuals(pairs, camera)
    assert np.sqrt(np.mean(distances**2)) == pytest.approx(0.25, rel=0.05)
    assert len(x) == len(distances) == 2 * sum(map(len, pairs.inliers))


def test_an_error_of_the_lens_model_appears_in_its_cells(camera, make_pairs):
    """A dent: keypoints of a few cells lie two pixels too low. Partners of most lie elsewhere."""
    size = np.array([camera.width, camera.height])
    low, high = np.array([7.0, 3.0]) / 14.0, np.array([9.0, 5.0]) / 14.0

    def dent(x):
        inside = ((x > low * size[0]) & (x < high * size[0])).all(axis=1)
        return inside[:, None] * [0.0, 2.0]

    pairs = make_pairs(camera, lens_error=dent, points=2500)
    grid = residual_grid(*epipolar_residuals(pairs, camera), (camera.width, camera.height))

    there = np.zeros(grid.shape, bool)
    there[3:5, 7:9] = True
    assert 0.1 < np.nanmedian(grid[~there]) < 0.2
    assert grid[there].min() > 1.5 * np.nanmedian(grid[~there])


@pytest.mark.parametrize("camera", ["perspective"], indirect=True)
def test_a_distorted_lens_is_undone_first(camera, make_pairs):
    """Matches that a barrel lens bent leave no more than noise, once it is known."""
    bent = replace(camera, distortion=(-0.1,))

    def bend(x):
        about = (x - camera.K[:2, 2]) / 800.0
        return 800.0 * about * -0.1 * np.sum(about**2, axis=1, keepdims=True)

    pairs = make_pairs(camera, noise_px=0.2, lens_error=bend)

    known, unknown = (np.sqrt(np.mean(epipolar_residuals(pairs, one)[1] ** 2)) for one in (bent, camera))
    assert known == pytest.approx(0.2, rel=0.1) and unknown > 1.0
