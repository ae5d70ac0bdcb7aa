"""Libraries that lie in wheels."""

import ctypes
import sys
from pathlib import Path
from types import SimpleNamespace

import PIL
import pytest

from sfm_app.operating_system import Ability, find_in_wheel, load_for_others

PILLOW = Path(PIL.__file__).parent


@pytest.mark.skipif(
    not any(find_in_wheel(PILLOW, "pillow", "libtiff")), reason="this Pillow has no libraries of its own"
)
def test_libraries_in_wheels_are_found_unless_there_are_none(without):
    assert [hasattr(library, "TIFFOpen") for library in find_in_wheel(PILLOW, "pillow", "libtiff")] == [True]
    assert list(find_in_wheel(PILLOW, "pillow", "libnothing")) == []

    without(Ability.WHEEL_LIBRARIES)
    assert list(find_in_wheel(PILLOW, "pillow", "libtiff")) == []


@pytest.mark.parametrize("there", [True, False])
def test_a_library_is_loaded_for_others_only_where_that_helps(monkeypatch, without, there):
    loaded = []
    monkeypatch.setitem(sys.modules, "a_library", SimpleNamespace(get_library_path=lambda: "x.so" if there else None))
    monkeypatch.setattr(ctypes, "CDLL", lambda name, mode: loaded.append((name, mode)))
    monkeypatch.setattr("sfm_app.operating_system.abilities.HERE", frozenset(Ability))
    load_for_others("a_library")
    assert loaded == ([("x.so", ctypes.RTLD_GLOBAL)] if there else [])

    without(Ability.GLOBAL_LIBRARIES)
    load_for_others("not installed")
    assert len(loaded) == there
