import numpy as np
import pytest

from sfm_app.selfcal import calibrate_photo_set
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, PhotoPairs


def unknown(pairs, options, seed):
    return Calibration(np.eye(3), *pairs.size, "zero-curves", False, "an orbit", spread={"fx": 3.0})


def fallen_back(*focals):
    hints = {key: focal for key, focal in enumerate(focals) if focal}
    sizes, groups = dict.fromkeys(range(len(focals)), (1000, 800)), dict.fromkeys(range(len(focals)), "one")
    pairs = PhotoPairs(np.empty((0, 3, 3)), np.empty(0), (), (), sizes, groups, hints)
    [camera] = calibrate_photo_set(pairs, unknown, CalibrationSettings(), 0, together=True)
    assert (camera.name, camera.photos) == ("one", tuple(range(len(focals))))
    return camera.found


def test_exif_comes_before_a_guess():
    found = fallen_back(None, 900.0, 910.0, 5000.0)
    assert (found.method, found.focal_px) == ("exif", 910.0)
    assert found.K[:2, 2].tolist() == [500.0, 400.0]
    assert (found.identifiable, found.reason, found.spread) == (False, "an orbit", {})


def test_without_exif_the_focal_is_the_usual_guess():
    found = fallen_back(None, None)
    assert found.method == "guess"
    assert found.focal_px == pytest.approx(1200)
