"""The panels about the lens, for every projection."""

import re

import numpy as np
import pytest

from sfm_app.estimation.fitting import to_calibration
from sfm_app.report.figures import Panel, draw_calibration, lens_curve
from sfm_app.selfcal.wide_lens import Fisheye, LensEstimate

SAYS = {
    "perspective": ["ideal pinhole", "square pixels", "votes"],
    "fisheye": ["ideal equidistant lens", "stereographic", "a fisheye that sees 141 degrees"],
    "equirectangular": ["equirectangular", "360-degree panoramas, 1000 x 500 px"],
}


@pytest.mark.slow
def test_every_projection_is_drawn_with_what_it_has(camera, seen, tmp_path):
    pairs = seen(camera)

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
