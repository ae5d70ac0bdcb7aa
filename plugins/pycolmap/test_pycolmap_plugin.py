"""Tests for COLMAP's estimators alone; those that all estimators pass are in tests/contract."""

import subprocess
import sys

import pytest

pytest.importorskip("sfm_app_pycolmap", reason="the plug-in is not installed: pip install -e plugins/pycolmap")

import numpy as np
import pycolmap
from sfm_app_pycolmap import fit_loransac

import sfm_app
from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import Rejected

OPTIONS = EpipolarSettings(max_error_px=1.5, max_trials=2000)
PAIR = make_pair(PairOptions(points=1000, outliers=0.3, sigma_px=1.5), 1)


def test_it_is_found_by_name():
    settings = sfm_app.Settings(epipolar=OPTIONS)
    found = sfm_app.estimate_fundamental(PAIR.x1, PAIR.x2, method="pycolmap-loransac", seed=3, settings=settings)
    np.testing.assert_array_equal(found.F, fit_loransac(PAIR.x1, PAIR.x2, OPTIONS, 3).F)


def test_the_threshold_is_a_sampson_distance_in_colmap():
    ransac = pycolmap.RANSACOptions(max_error=1.5, random_seed=1)
    found = pycolmap.estimate_fundamental_matrix(PAIR.x1, PAIR.x2, ransac)
    distance = sampson_distance(found["F"], PAIR.x1, PAIR.x2)
    np.testing.assert_array_equal(found["inlier_mask"], distance <= 1.5)


def test_the_seed_acts():
    found = [fit_loransac(PAIR.x1, PAIR.x2, OPTIONS, seed).F.tobytes() for seed in (1, 0, 1)]
    assert found[0] == found[2] != found[1]


def test_nothing_found_is_a_value(monkeypatch):
    monkeypatch.setattr(pycolmap, "estimate_fundamental_matrix", lambda *_: None)
    assert fit_loransac(PAIR.x1, PAIR.x2, OPTIONS, 0) == Rejected("no model found")


def test_compressing_still_works_when_the_plug_in_is_imported_first():
    code = "import sfm_app_pycolmap, zlib; print(len(zlib.decompress(zlib.compress(bytes(100000)))))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "100000"
