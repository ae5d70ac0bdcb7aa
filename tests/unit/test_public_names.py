import numpy as np
import pytest

import sfm_app


def test_every_public_name_exists():
    assert {"reconstruct", "calibrate_photos", "estimate_fundamental", "calibrate_fundamentals", "Settings"} <= set(
        sfm_app.__all__
    )
    assert all(getattr(sfm_app, name) is not None for name in sfm_app.__all__)


def test_an_estimator_refuses_bad_input_clearly():
    with pytest.raises(ValueError, match="x2"):
        sfm_app.estimate_fundamental(np.zeros((9, 2)), np.full((9, 2), np.nan))
    with pytest.raises(sfm_app.ConfigError, match="no calibrator is named 'kruppa5'"):
        sfm_app.calibrate_fundamentals(np.eye(3)[None], (640, 480), method="kruppa5")
