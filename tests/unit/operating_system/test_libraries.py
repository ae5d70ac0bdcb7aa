"""Libraries that lie in wheels."""

from pathlib import Path

import PIL
import pytest

from sfm_app.operating_system import Ability, find_in_wheel

PILLOW = Path(PIL.__file__).parent


@pytest.mark.skipif(
    not any(find_in_wheel(PILLOW, "pillow", "libtiff")), reason="this Pillow has no libraries of its own"
)
def test_libraries_in_wheels_are_found_unless_there_are_none(without):
    assert [hasattr(library, "TIFFOpen") for library in find_in_wheel(PILLOW, "pillow", "libtiff")] == [True]
    assert list(find_in_wheel(PILLOW, "pillow", "libnothing")) == []

    without(Ability.WHEEL_LIBRARIES)
    assert list(find_in_wheel(PILLOW, "pillow", "libtiff")) == []
