import numpy as np
import pytest

from sfm_app.stages.intrinsics import fall_back
from sfm_app.types import Calibration, MatchedImage

UNKNOWN = Calibration(np.eye(3), 1000, 800, "zero-curves", False, "an orbit", spread={"fx": 3.0})


def photos(*focals):
    return [MatchedImage(key, f"{key}.jpg", "one", 1000, 800, focal) for key, focal in enumerate(focals)]


def test_exif_comes_before_a_guess():
    found = fall_back(UNKNOWN, photos(None, 900.0, 910.0, 5000.0))

    assert (found.method, found.focal_px) == ("exif", 910.0)
    assert found.K[:2, 2].tolist() == [500.0, 400.0]
    assert (found.identifiable, found.reason, found.spread) == (False, "an orbit", {})


def test_without_exif_the_focal_is_the_usual_guess():
    found = fall_back(UNKNOWN, photos(None, None))

    assert found.method == "guess"
    assert found.focal_px == pytest.approx(1200)
