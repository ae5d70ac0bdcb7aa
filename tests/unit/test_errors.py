"""Errors cross processes and have exit codes; what is no number, and whose error it is that ends something."""

import json
import pickle

import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap, translate_errors
from sfm_app.errors import BackendError, ConfigError, NumericalError, SfmError
from sfm_app.geometry.poses import umeyama
from sfm_app.numerical import FAILURES, finite_entries, json_text
from sfm_app.types import Calibration

EVERY_ERROR = [SfmError, *SfmError.__subclasses__()]


@pytest.mark.parametrize("error", EVERY_ERROR)
def test_errors_cross_worker_processes(error):
    copy = pickle.loads(pickle.dumps(error("what", hint="how")))  # noqa: S301
    assert (type(copy), str(copy), copy.hint) == (error, "what", "how")


OURS = {
    "no inverse": lambda: np.linalg.inv(np.zeros((2, 2))), "not positive": lambda: np.linalg.cholesky(-np.eye(3)),
    "not positive, many": lambda: np.linalg.cholesky(np.zeros((4, 3, 3))), "division": lambda: 1.0 / (len([]) * 1.0),
    "the power of nothing": lambda: 0.0**-2.0, "overflow": lambda: 10.0**400,
}  # fmt: skip
BUGS = {
    "the quantile of nothing": lambda: np.quantile(np.zeros(0), 0.5),
    "the largest of nothing": lambda: np.ptp(np.zeros(0)),
    "shapes that do not fit": lambda: umeyama(np.zeros((4, 3)), np.zeros((5, 3))),
}


@pytest.mark.parametrize("case", BUGS)
def test_a_bug_of_ours_is_no_failed_computation(case):
    with pytest.raises((ValueError, IndexError)) as caught, translate_errors("adjusting"):
        BUGS[case]()
    assert not isinstance(caught.value, FAILURES)


@pytest.mark.parametrize("case", OURS)
def test_an_error_of_ours_is_not_called_colmaps(case):
    with (
        pytest.raises(NumericalError, match="computation failed while adjusting: ") as caught,
        translate_errors("adjusting"),
    ):
        OURS[case]()
    assert isinstance(caught.value.__cause__, FAILURES) and "bug" in caught.value.hint
    copy = pickle.loads(pickle.dumps(caught.value))  # noqa: S301 - our own bytes
    assert (str(copy), copy.exit_code) == (str(caught.value), 7)


def test_what_pycolmap_raises_is_colmaps_and_other_bugs_stay_what_they_are(tmp_path):
    with pytest.raises(BackendError, match="COLMAP failed while reading"), translate_errors("reading"):
        pycolmap.Reconstruction(tmp_path / "nowhere")
    with pytest.raises(BackendError), translate_errors("reading"):
        raise RuntimeError("from C++, which has no frames")
    with pytest.raises(ConfigError), translate_errors("reading"):
        raise ConfigError("ours")


def test_json_has_no_infinity_and_no_nan():
    given = {"a": np.nan, "b": [1.0, np.inf, (-np.inf, "x")], "c": {"d": np.float64("nan"), "e": True, "f": None}}
    assert json.loads(json_text(given), parse_constant=pytest.fail) == {
        "a": None, "b": [1.0, None, [None, "x"]], "c": {"d": None, "e": True, "f": None},
    }  # fmt: skip
    assert finite_entries({"fx": 1.0, "fy": np.inf, "cx": np.nan, "cy": None}) == {"fx": 1.0}


def test_a_calibration_comes_back_without_what_is_no_number():
    given = Calibration(np.eye(3), 640, 480, "zero-curves", True, spread={"fx": np.inf, "fy": 2.0})
    found = Calibration.from_dict(json.loads(json_text(given.to_dict())))
    assert found.spread == {"fy": 2.0} and np.array_equal(found.K, np.eye(3))
