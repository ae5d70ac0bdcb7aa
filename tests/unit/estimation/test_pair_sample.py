"""Cameras are calibrated from a sample of the pairs of a large set, which every photo is part of."""

from dataclasses import replace

import numpy as np

from sfm_app.estimation import calibrating as module
from sfm_app.estimation.calibrating import sample_pairs
from sfm_app.types import EpipolarFit, ViewGraph


def view_graph(photos, reach, degenerate=()):
    """Photos in a row; each is paired with those within reach, and shares less with those further away."""
    pairs = [(a, b) for a in range(photos) for b in range(a + 1, min(a + reach + 1, photos))]
    fits = {}
    for a, b in pairs:
        inliers, kind = np.arange(200) < 200 - 5 * (b - a), "planar" if (a, b) in degenerate else ""
        fits[a, b] = EpipolarFit(np.eye(3), inliers, np.ones(200), 1, 0.3, kind)
    return ViewGraph(fits, {})


def test_all_pairs_of_a_small_set_are_asked():
    views = view_graph(20, 10)

    assert sample_pairs(views, 20) is views


def test_every_photo_of_a_large_set_is_asked_with_near_and_far_partners(monkeypatch):
    monkeypatch.setattr(module, "OPTIONS", replace(module.OPTIONS, all_pairs=300))
    views = view_graph(200, 20)

    found = sample_pairs(views, 200)

    counts = np.bincount(np.array(list(found.fits)).ravel(), minlength=200)
    assert counts.min() >= module.OPTIONS.pairs_per_photo
    assert 400 <= len(found.fits) <= 800 < len(views.fits)
    gaps = [b - a for a, b in found.fits]
    assert min(gaps) == 1 and np.mean(np.array(gaps) > 10) > 0.2


def test_pairs_that_determine_no_matrix_are_not_asked(monkeypatch):
    monkeypatch.setattr(module, "OPTIONS", replace(module.OPTIONS, all_pairs=300))
    flat = {(a, a + 1) for a in range(199)}

    found = sample_pairs(view_graph(200, 20, degenerate=flat), 200)

    assert flat.isdisjoint(found.fits)
