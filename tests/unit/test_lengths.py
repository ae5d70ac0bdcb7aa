"""Lengths and points as people write them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.wording import format_length, parse_length, parse_point


@pytest.mark.parametrize(
    ("text", "meters"),
    [("1.25m", 1.25), ("50 mm", 0.05), ("50mm", 0.05), ("3ft", 0.9144), ('2"', 0.0508), ("1.2e1 CM", 0.12)],
)
def test_lengths_are_read(text, meters):
    assert parse_length(text) == pytest.approx(meters, rel=1e-12)


@pytest.mark.parametrize("text", ["", "m", "50", "1.2.3m", "-1m", "0", "nan", "inf", "1 parsec", "1m 20", "1e400"])
def test_what_is_no_length_says_what_one_looks_like(text):
    with pytest.raises(ValueError, match="is no length"):
        parse_length(text)


@given(st.floats(1e-4, 1e5))
def test_a_length_that_is_written_is_read_again(meters):
    assert parse_length(format_length(meters)) == pytest.approx(meters, rel=6e-4)


def test_points_are_read():
    assert parse_point("0.5,-1.25, 3") == (0.5, -1.25, 3.0)


@pytest.mark.parametrize("text", ["", "1,2", "1,2,3,4", "1,2,x", "1,nan,2", "1 2 3"])
def test_what_is_no_point_says_what_one_looks_like(text):
    with pytest.raises(ValueError, match="is no point"):
        parse_point(text)
