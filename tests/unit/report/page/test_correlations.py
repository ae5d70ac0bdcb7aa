"""What the page says of parameters that move together."""

import numpy as np

from sfm_app.report.findings import correlation_table, correlation_text
from sfm_app.types import Calibration, CameraModel

PAIRS = Calibration(
    np.eye(3), 640, 480, "zero-curves", True, held=("aspect",),
    correlations={"fx fy": 0.99, "fx cx": 0.1, "fx cy": -0.2, "fx k1": 0.94, "cx cy": 0.0, "cx k1": 0.3,
                  "cy k1": -0.61},
)  # fmt: skip


def adjusted(determined, params, **correlations):
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    values = {key.replace("_", " "): value for key, value in correlations.items()}
    return CameraModel("OPENCV", params, np.eye(3), 640, 480, dict.fromkeys(names, 1.0), determined, values)


def test_parameters_that_move_together_are_named_the_strongest_first():
    found = correlation_table(PAIRS, None)

    assert found.source == "from pairs of photos"
    assert list(found.names) == ["focal", "cx", "cy", "k1"]
    assert found.rows[3] == [0.94, 0.3, -0.61, None] and found.rows[1] == [0.1, None, None, None]
    assert list(found.texts) == [
        "focal and k1 move together: 0.94",
        "cy and k1 move against each other: \N{MINUS SIGN}0.61",
    ]


def test_the_last_adjustment_counts_and_terms_that_are_zero_do_not():
    params = (900.0, 800.0, 320.0, 240.0, -0.1, 0.0, 1e-4, -1e-4)
    found = correlation_table(PAIRS, adjusted(("aspect", "k1"), params, fx_fy=0.4, fx_k1=-0.3, k1_p1=0.2, fx_k2=0.9))

    assert found.source == "after the last adjustment"
    assert list(found.names) == ["fx", "fy", "cx", "cy", "k1", "p1", "p2"]
    assert list(found.texts) == ["no strong correlation; the strongest is fx with fy, 0.40"]


def test_a_long_list_is_cut_and_counted():
    strong = {f"{a}_{b}": 0.7 for a, b in (("fx", "fy"), ("fx", "cx"), ("fx", "cy"), ("fy", "cx"), ("cx", "cy"))}
    found = correlation_table(PAIRS, adjusted(("aspect",), (900.0, 900.0, 320.0, 240.0, 0, 0, 0, 0), **strong))

    assert len(found.texts) == 4 and found.texts[-1] == "and 2 more pairs of parameters"


def test_nothing_is_said_where_nothing_is_known():
    guess = Calibration(np.eye(3), 640, 480, "guess", False, correlations=PAIRS.correlations)

    assert correlation_table(guess, None) is None
    assert correlation_table(guess, adjusted((), (0.0,) * 8, fx_k1=0.9)) is None


def test_a_correlation_has_two_digits_and_no_negative_zero():
    assert [correlation_text(value) for value in (-0.001, 0.996, -0.5)] == ["0.00", "1.00", "\N{MINUS SIGN}0.50"]
