"""Lengths, points and lists of names as text."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.wording import format_length, list_names, parse_length, parse_point


@pytest.mark.parametrize(
    ("text", "meters"),
    [("1.25m", 1.25), ("50 mm", 0.05), ("50mm", 0.05), ("3ft", 0.9144), ('2"', 0.0508), ("1.2e1 CM", 0.12)],
)
def test_lengths_are_read(text, meters):
    assert parse_length(text) == pytest.approx(meters, rel=1e-12)


@pytest.mark.parametrize("text", ["", "m", "50", "1.2.3m", "-1m", "0", "nan", "inf", "1 parsec", "1m 20", "1e400"])
def test_a_malformed_length_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match="is no length"):
        parse_length(text)


@given(st.floats(1e-4, 1e5))
def test_a_length_that_is_written_is_read_again(meters):
    assert parse_length(format_length(meters)) == pytest.approx(meters, rel=6e-4)


def test_points_are_read():
    assert parse_point("0.5,-1.25, 3") == (0.5, -1.25, 3.0)


@pytest.mark.parametrize("text", ["", "1,2", "1,2,3,4", "1,2,x", "1,nan,2", "1 2 3"])
def test_a_malformed_point_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match="is no point"):
        parse_point(text)


@pytest.mark.parametrize(
    ("count", "text"), [(0, ""), (1, "a"), (2, "a, b"), (3, "a, b and 1 more"), (5, "a, b and 3 more")]
)
def test_the_first_few_are_named(count, text):
    assert list_names("abcde"[:count], 2) == text
