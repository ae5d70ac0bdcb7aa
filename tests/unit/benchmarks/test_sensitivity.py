"""Constants are changed one at a time, and nothing else is."""

import importlib
import sys
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks.sensitivity.command import difference, page, row_of
from benchmarks.sensitivity.constants import ROOMS, Constant, constants, install, is_compiled, scale


class Limits(NamedTuple):
    """A constant of several numbers."""

    least: float
    most: int


@pytest.mark.parametrize(
    ("value", "halved", "doubled"),
    [
        (3.0, 1.5, 6.0),
        (0.2, 0.1, 0.4),
        (0.9, 0.95, 0.8),
        (1, 1, 2),
        (5, 2, 10),
        ((0.2, "name"), (0.1, "name"), (0.4, "name")),
        ({"a": 2}, {"a": 1}, {"a": 4}),
        (Limits(0.25, 8), Limits(0.125, 4), Limits(0.5, 16)),
        (True, True, True),
        (None, None, None),
    ],
)
def test_numbers_are_scaled_and_stay_what_they_are(value, halved, doubled):
    assert scale(value, 0.5) == pytest.approx(halved)
    assert scale(value, 2.0) == pytest.approx(doubled)
    assert type(scale(value, 0.5)) is type(value)


def test_arrays_are_scaled():
    np.testing.assert_array_equal(scale(np.array([1.0, 3.0]), 2.0), [2.0, 6.0])


def test_every_room_has_constants_and_kernels_are_known():
    found = constants()
    assert {one.path.split("/")[1] for one in found} == set(ROOMS)
    compiled = sum(map(is_compiled, found))
    assert 0 < compiled < len(found) / 2


MODULE = '''
from dataclasses import dataclass

SPREAD, STEPS = 0.25, 4
"""Chosen by hand."""
WIDTH = 3.0
"""Thesis 4.4."""


@dataclass(frozen=True, slots=True)
class LoopOptions:
    """Of the loop."""

    gain: float = 2.0
    """By hand."""
    most: int = 8
    """Thesis 4.5."""


OPTIONS = LoopOptions()
'''


@pytest.fixture
def room(tmp_path, monkeypatch):
    """The folder of a module with constants; what is imported from it is forgotten."""
    (tmp_path / "sfm_app" / "room").mkdir(parents=True)
    (tmp_path / "sfm_app" / "room" / "scaled_module.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.setattr(sys, "meta_path", sys.meta_path[:])
    yield tmp_path
    sys.modules.pop("scaled_module", None)


def test_constants_chosen_by_hand_are_found_in_options_too(room):
    path = "sfm_app/room/scaled_module.py"
    assert constants(["room"], room) == [Constant(path, "SPREAD, STEPS"), Constant(path, "LoopOptions.gain")]


@pytest.mark.parametrize(
    ("names", "values"),
    [("SPREAD, STEPS", (0.5, 8, 3.0, 2.0, 8)), ("LoopOptions.gain", (0.25, 4, 3.0, 4.0, 8))],
)
def test_whoever_imports_a_constant_sees_it_scaled(room, names, values):
    install(Constant("scaled_module.py", names), 2.0, room / "sfm_app" / "room")
    module = importlib.import_module("scaled_module")
    assert (module.SPREAD, module.STEPS, module.WIDTH, module.OPTIONS.gain, module.OPTIONS.most) == values


def test_a_module_that_is_imported_already_is_refused():
    with pytest.raises(RuntimeError, match="imported already"):
        install(Constant("sfm_app/settings.py", "ANY"), 2.0)


def test_rows_show_differences_and_failures():
    usual = {"one": {"AUC@5": 0.5, "focal %": 1.0}, "two": {"AUC@5": 0.7, "focal %": 3.0}}
    found = {"one": {"AUC@5": 0.4, "focal %": 2.0}, "two": {"AUC@5": 0.8, "focal %": 3.0}}
    better = difference(found, usual)
    assert better == pytest.approx({"AUC@5": 0.0, "worst": -0.1, "focal %": 0.5})
    row = row_of("room: NAME", better, difference({"one": {"failed": "ValueError: no"}}, usual))
    assert (row["AUC@5, halved"], row["AUC@5, doubled"], row["worst"]) == (0.0, "ValueError: no", -0.1)
    assert "room: NAME" in page([row])
