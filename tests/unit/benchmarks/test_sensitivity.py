"""Constants are changed one at a time, and nothing else is."""

import ast
import json
import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks.common.processes import environment
from benchmarks.common.results import RESULTS
from benchmarks.sensitivity.command import difference, label, page, row_of
from benchmarks.sensitivity.constants import ROOT, Constant, assignments, constants, install, is_compiled, scale


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
    assert {one.path.split("/")[1] for one in found} == {"ransac", "selfcal", "geometry", "posegraph"}
    compiled = sum(map(is_compiled, found))
    assert 0 < compiled < len(found) / 2


def test_whoever_imports_a_constant_sees_it_scaled():
    code = (
        "import json; from benchmarks.sensitivity.constants import Constant, install;"
        "install(Constant('sfm_app/selfcal/priors.py', 'HINT_SPREAD'), 2.0);"
        "from sfm_app.selfcal.adjustment import camera_priors as here;"
        "from sfm_app.selfcal.cameras import multi_camera as there;"
        "print(json.dumps([here.HINT_SPREAD, there.HINT_SPREAD, here.FOCAL_SPREAD]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment())
    from sfm_app.selfcal import priors as usual

    assert json.loads(done.stdout) == [2 * usual.HINT_SPREAD, 2 * usual.HINT_SPREAD, usual.FOCAL_SPREAD]


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


def test_what_is_said_to_be_measured_has_a_row():
    rows = {row["constant"] for row in json.loads((RESULTS / "sensitivity.json").read_text(encoding="utf-8"))["rows"]}
    said = {
        label(Constant(path.relative_to(ROOT).as_posix(), names))
        for path in (ROOT / "sfm_app").rglob("*.py")
        for names, _, about in assignments(ast.parse(path.read_text(encoding="utf-8")))
        if "halved and doubled by `benchmarks.sensitivity`" in about
    }
    assert len(said) > 100
    assert said - rows == set()
