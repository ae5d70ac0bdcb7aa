"""Samples of pairs, and inliers through a lens."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.lenses.distortion import calibrate, photograph
from sfm_app.camera.models import FAMILIES, row_of_calibration
from sfm_app.camera.projection import image_points
from sfm_app.estimation import calibrating as module
from sfm_app.estimation.calibrating import sample_pairs, select_inliers_through_lens
from sfm_app.plugins import load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.selfcal import CalibratedCamera
from sfm_app.settings import Settings
from sfm_app.stages import view_graph
from sfm_app.synthetic.cameras import Lens, axis_rotation
from sfm_app.types import Calibration, EpipolarFit, ViewGraph
from sfm_app.types.camera import PERSPECTIVE


def row_of_photos(photos, reach, degenerate=()):
    """Photos in a row; each is paired with those within reach, and shares less with those further away."""
    pairs = [(a, b) for a in range(photos) for b in range(a + 1, min(a + reach + 1, photos))]
    fits = {}
    for a, b in pairs:
        inliers, kind = np.arange(200) < 200 - 5 * (b - a), "planar" if (a, b) in degenerate else ""
        fits[a, b] = EpipolarFit(np.eye(3), inliers, np.ones(200), 1, 0.3, kind)
    return ViewGraph(fits, {})


def test_all_pairs_of_a_small_set_are_asked():
    views = row_of_photos(20, 10)
    assert sample_pairs(views, 20) is views


def test_every_photo_of_a_large_set_is_asked_with_near_and_far_partners(monkeypatch):
    monkeypatch.setattr(module.OPTIONS, "all_pairs", 300)
    views = row_of_photos(200, 20)
    found = sample_pairs(views, 200)
    counts = np.bincount(np.array(list(found.fits)).ravel(), minlength=200)
    assert counts.min() >= module.OPTIONS.pairs_per_photo
    assert 400 <= len(found.fits) <= 800 < len(views.fits)
    gaps = [b - a for a, b in found.fits]
    assert min(gaps) == 1 and np.mean(np.array(gaps) > 10) > 0.2


def test_pairs_that_determine_no_matrix_are_not_asked(monkeypatch):
    monkeypatch.setattr(module.OPTIONS, "all_pairs", 300)
    flat = {(a, a + 1) for a in range(199)}
    found = sample_pairs(row_of_photos(200, 20, degenerate=flat), 200)
    assert flat.isdisjoint(found.fits)


PHOTOS = (1, 2, 3, 4)


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    """Matches of four photos through a pincushion lens, their fundamental matrices, and K."""
    matches, K = photograph(Lens(radial=(0.2,)), 3)
    kept = {pair: rows for pair, rows in matches.matches.items() if set(PHOTOS) >= set(pair)}
    matches = type(matches)({key: matches.images[key] for key in PHOTOS}, matches.keypoints, kept)
    with make_executor(1) as executor:
        run = RunContext(Settings(), Workspace(tmp_path_factory.mktemp("run")), load_plugins(), executor, 1)
        yield matches, view_graph.make(matches, run), K, run


def camera(K, radial, *, identifiable=True):
    found = Calibration(K, 1200, 900, "zero-curves", identifiable, distortion=(radial,))
    return [CalibratedCamera("one", PHOTOS, found)]


def inliers_of(views):
    return sum(fit.inlier_count for fit in views.fits.values())


def test_the_right_lens_gives_inliers_back(bent):
    matches, views, K, run = bent
    again = select_inliers_through_lens(matches, views, camera(K, 0.2), run)
    right = sum(int(np.count_nonzero(rows[:, 0] == rows[:, 1])) for rows in matches.matches.values())
    assert inliers_of(views) < 0.85 * right
    assert 0.97 * right < inliers_of(again) < 1.03 * right
    assert all(np.array_equal(again.fits[pair].F, fit.F) for pair, fit in views.fits.items())


@pytest.mark.parametrize(("radial", "identifiable"), [(0.0, True), (0.01, True), (0.2, False)])
def test_without_a_known_lens_nothing_changes(bent, radial, identifiable):
    matches, views, K, run = bent
    assert select_inliers_through_lens(matches, views, camera(K, radial, identifiable=identifiable), run) is views


def test_a_wrong_lens_takes_no_inliers_away(bent):
    matches, views, K, run = bent
    again = select_inliers_through_lens(matches, views, camera(K, -0.3), run)
    for pair, fit in views.fits.items():
        assert again.fits[pair].inlier_count >= 0.7 * fit.inlier_count


@pytest.mark.parametrize(("relief", "kind"), [(0.0, "planar"), (2.0, "")])
def test_a_plane_is_a_plane_through_a_lens_that_bends_it(bent, relief, kind):
    matches, _, K, run = bent
    rng, lens = np.random.default_rng(0), Calibration(K, 1200, 900, "zero-curves", True, distortion=(-0.2,))
    X = np.column_stack([rng.uniform([-3, -2], [3, 2], (400, 2)), 6 + relief * rng.uniform(size=400)])
    turn = axis_rotation(np.array([0.0, 1.0, 0.0]), 20.0)
    row, family = row_of_calibration(lens), FAMILIES[PERSPECTIVE]
    x = [image_points(points, row, family) for points in (X, X @ turn.T - [2.0, 0.3, -0.5])]
    inside = np.logical_and(*(((view > 0) & (view < [1200, 900])).all(axis=1) for view in x))
    count = int(inside.sum())
    rows = np.repeat(np.arange(count, dtype=np.uint32)[:, None], 2, axis=1)
    images = {number: matches.images[number] for number in (1, 2)}
    flat = type(matches)(images, {1: x[0][inside], 2: x[1][inside]}, {(1, 2): rows})
    views = ViewGraph({(1, 2): EpipolarFit(np.eye(3), np.ones(count, bool), np.ones(count), 1, 0.3)}, {})
    again = select_inliers_through_lens(flat, views, [CalibratedCamera("one", (1, 2), lens)], run).fits[1, 2]
    assert count > 100 and again.inlier_count == count and again.degeneracy == kind


@pytest.mark.slow
def test_the_focal_is_right_before_adjustment():
    k1 = -0.15
    matches, K = photograph(Lens(radial=(k1,)), 5)
    found = calibrate(matches, 5)
    assert found.identifiable and found.projection == "perspective"
    assert 0.0 < abs(found.focal_px / K[0, 0] - 1.0) < 0.004
    assert found.radial == pytest.approx(k1, abs=0.01)


def test_a_reason_names_a_degeneracy_only_where_most_pairs_have_it():
    found = Calibration(np.eye(3), 100, 80, "guess", identifiable=False, reason="an orbit")
    camera = CalibratedCamera("one", (0, 1, 2), found)
    mostly, hardly = row_of_photos(3, 2, {(0, 1), (1, 2)}), row_of_photos(3, 2, {(0, 1)})
    assert module.explain_failure(camera, mostly).reason == "an orbit; everything lies in one plane (2 of 3 pairs)"
    assert module.explain_failure(camera, hardly).reason == "an orbit"
    known = replace(camera, found=replace(found, identifiable=True, reason=""))
    assert module.explain_failure(known, mostly).reason == ""
