"""The Kruppa equations against their textbook form, and the focal-only solution."""

import numpy as np
import pytest

from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis.constraint_forms import Halves
from sfm_app.selfcal.thesis.kruppa import METHOD, calibrate, kruppa_equations, kruppa_ratios, pair_focals
from sfm_app.settings import CalibrationSettings
from sfm_app.types import CameraPairs

OPTIONS = CalibrationSettings()


def in_widths(Fs, size=(1000, 750)):
    return prepare(CameraPairs.from_Fs(Fs, size), unit_px=size[0], origin_px=(0.0, 0.0))


def camera_of(K, factor=1.0):
    return np.array([factor * K[0, 0], factor * K[1, 1], K[0, 2], K[1, 2]]) / 1000


def test_true_cameras_satisfy_5_5_and_the_equations(views):
    made = views(4, noise=0.0, focal=900, aspect=1.1, center=(450, 400))
    pairs = in_widths(made.Fs)
    C = (made.K / [[1000], [1000], [1]]) @ (made.K / [[1000], [1000], [1]]).T
    for F, e2 in zip(pairs.F, pairs.e2, strict=True):
        cross = np.cross(np.eye(3), e2)
        left, right = cross @ C @ cross.T, F @ C @ F.T
        np.testing.assert_allclose(left / np.linalg.norm(left), right / np.linalg.norm(right), atol=1e-9)

    halves = Halves.from_fundamentals(pairs.F)
    assert np.abs(kruppa_equations(halves, camera_of(made.K))).max() < 1e-9
    ratios = kruppa_ratios(halves, camera_of(made.K))
    np.testing.assert_allclose(ratios[:, [1, 2]], ratios[:, [0, 0]], rtol=1e-6)


def test_other_cameras_do_not(views):
    made = views(4, noise=0.0)
    errors = np.linalg.norm(
        kruppa_equations(Halves.from_fundamentals(in_widths(made.Fs).F), camera_of(made.K, 1.2)), axis=-1
    )
    assert errors.min() > 1e-3
    assert errors.max() <= 1


def test_scale_and_sign_of_f_have_no_effect(views):
    made = views(3, noise=0.01)
    expected = kruppa_equations(Halves.from_fundamentals(in_widths(made.Fs).F), camera_of(made.K))
    found = kruppa_equations(Halves.from_fundamentals(in_widths(-1e5 * made.Fs).F), camera_of(made.K))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.linalg.norm(expected, axis=1), rtol=1e-6)


@pytest.mark.parametrize("focal", [400.0, 1000.0, 2500.0])  # 1000 px is the width: f = 1 is a trivial root
def test_the_focal_of_an_exact_pair_is_the_true_one(views, focal):
    made = views(5, seed=3, noise=0.0, focal=focal, center=(520, 340))
    np.testing.assert_allclose(pair_focals(in_widths(made.Fs), (0.52, 0.34)), focal / 1000, rtol=1e-6)


def test_noise_moves_the_focal_a_little(views):
    made = views(6, seed=1, noise=1e-3)
    focals = pair_focals(in_widths(made.Fs), (0.5, 0.375))
    assert 1e-4 < abs(np.nanmedian(focals) - 1) < 0.05


def test_a_focal_is_found_where_the_linear_equations_fail(views):
    # level cameras: all optical axes in one plane, only the quadratic equation is left
    made = views(5, seed=2, noise=0.0, motion=views.level)
    focals = pair_focals(in_widths(made.Fs), (0.5, 0.375))
    np.testing.assert_allclose(focals[np.isfinite(focals)], 1.0, rtol=1e-5)
    assert np.count_nonzero(np.isfinite(focals)) >= 8


@pytest.mark.parametrize("motion", ["orbit", "translation"])
def test_pairs_without_a_focal_give_none(views, motion):
    made = views(5, noise=0.0, motion=getattr(views, motion))
    assert np.all(np.isnan(pair_focals(in_widths(made.Fs), (0.5, 0.375))))


def test_finds_the_camera(views):
    made = views(6, noise=5e-4, aspect=1.1, center=(530, 350))
    found = calibrate(CameraPairs.from_Fs(made.Fs, made.size), OPTIONS, 0)
    assert (found.identifiable, found.method) == (True, METHOD), found.reason
    assert 0 < np.abs(found.K - made.K).max() < 30
    assert found.evidence["focal_estimates"] == 10  # the center is off: five pairs ask for f^2 < 0


def test_without_any_focal_of_its_own_it_starts_from_the_usual_one(views):
    made = views(5, noise=0.0, motion=views.orbit)
    found = calibrate(CameraPairs.from_Fs(made.Fs, made.size), OPTIONS, 0)
    assert not found.identifiable
    assert found.evidence["focal_estimates"] == 0
