"""Lists of names."""

import pytest

from sfm_app.wording import list_names


@pytest.mark.parametrize(
    ("count", "text"), [(0, ""), (1, "a"), (2, "a, b"), (3, "a, b and 1 more"), (5, "a, b and 3 more")]
)
def test_the_first_few_are_named(count, text):
    assert list_names("abcde"[:count], 2) == text
