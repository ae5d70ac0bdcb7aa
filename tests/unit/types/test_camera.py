"""Calibrations survive their file; correlations are those of drawn values."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sfm_app.types import Calibration, Intrinsics
from sfm_app.types.camera import named_correlations

FOUND = Calibration(
    np.array([[900.5, 0, 501.25], [0, 901.5, 373.0], [0, 0, 1]]), 1000, 750, "zero-curves", True, distortion=(-0.0625,),
    spread={"fx": 3.5, "k1": 0.01}, correlations={"fx k1": -0.75}, held=("aspect",),
    key_pairs=((1, 4), (2, 7)), evidence={"pairs": 12.0},
)  # fmt: skip
UNKNOWN = Calibration(np.diag([1200.0, 1200.0, 1.0]), 1000, 750, "claim", False, "an orbit")


def test_every_field_of_a_calibration_survives():
    for one in (FOUND, UNKNOWN):
        back = Calibration.from_dict(json.loads(json.dumps(one.to_dict())))
        np.testing.assert_array_equal(back.K, one.K)
        for name in one.__slots__:
            assert name == "K" or getattr(back, name) == getattr(one, name)
            assert type(getattr(back, name)) is type(getattr(one, name))


def test_all_terms_of_a_lens_survive():
    terms = (-0.1, 0.02, 0.001, -0.002, 0.0, 0.0, 0.0, 0.0)
    one = replace(FOUND, distortion=terms, method="kept")
    assert Calibration.from_dict(json.loads(json.dumps(one.to_dict()))).distortion == terms
    assert one.is_kept and one.is_given and one.is_bent and not FOUND.is_given


def test_cameras_keep_their_order_names_and_photos():
    taken = {"b.jpg": "zoom", "a.jpg": "zoom #2"}
    one = Intrinsics({"zoom": FOUND, "zoom #2": UNKNOWN}, taken)

    back = Intrinsics.from_dict(json.loads(json.dumps(one.to_dict())))

    assert list(back.cameras) == ["zoom", "zoom #2"]
    assert back.camera_of == taken
    assert (back.main.method, back.identifiable) == ("zero-curves", True)
    np.testing.assert_array_equal(back.K, FOUND.K)


def test_pairs_of_parameters_have_the_correlation_of_drawn_values():
    root = np.array([[2.0, 0.0, 0.0], [-30.0, 10.0, 0.0], [0.001, 0.0, 0.003]])
    drawn = np.random.default_rng(0).normal(size=(20_000, 3)) @ root.T
    expected = np.corrcoef(drawn.T)

    found = named_correlations(("fx", "cx", "k1"), root @ root.T)

    assert list(found) == ["fx cx", "fx k1", "cx k1"]
    assert list(found.values()) == pytest.approx(expected[np.triu_indices(3, 1)], abs=0.02)


def test_fixed_and_unknown_parameters_have_no_correlation():
    covariance = np.diag([1.0, 0.0, np.inf, 4.0])
    covariance[0, 3] = covariance[3, 0] = 3.0  # more than a covariance can be: rounding may do so

    assert named_correlations(("a", "b", "c", "d"), covariance) == {"a d": 1.0}
    assert named_correlations((), np.zeros((0, 0))) == {}
