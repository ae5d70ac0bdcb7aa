import importlib
import subprocess
import sys

import numba
import numpy as np
import pytest

from sfm_app.jit import is_waiting, kernel, summing_kernel, wait_where

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("decorator", [kernel, summing_kernel])
def test_a_kernel_compiles_where_nothing_can_be_cached(monkeypatch, decorator):
    real = numba.njit

    def njit(*functions, **options):
        if options.get("cache"):
            raise RuntimeError("cannot cache function 'twice': no locator available")
        return real(*functions, **options)

    monkeypatch.setattr(numba, "njit", njit)

    @decorator
    def twice(x):
        return 2 * x

    assert twice(3.5) == 7.0


def test_sums_in_lanes_still_know_infinities():
    @summing_kernel
    def total(values):
        found = 0.0
        for k in range(values.shape[0]):
            found += values[k]
        return found

    values = np.random.default_rng(0).normal(size=1001)
    assert total(values) == pytest.approx(values.sum(), rel=1e-12)
    values[500] = np.inf
    assert total(values) == np.inf
    values[0] = -np.inf
    assert np.isnan(total(values))


CODE = """
from typing import NamedTuple
from sfm_app.jit import kernel

class {name}(NamedTuple):
    value: float

@kernel
def twice(thing):
    return 2.0 * thing.value

print(twice({name}(21.0)))
"""


def test_a_cache_that_names_a_class_which_is_gone_is_made_anew(tmp_path):
    """As an upgrade leaves it behind."""
    for name in ("Old", "New"):
        (tmp_path / "module.py").write_text(CODE.format(name=name), encoding="utf-8")
        # imported, not run: numba pickles the class by its module
        done = subprocess.run(
            [sys.executable, "-c", "import module"], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert (done.stdout.strip(), done.returncode) == ("42.0", 0), done.stderr
    assert list(tmp_path.rglob("*.nbi"))


def test_who_waits_for_another_process_is_told_so(tmp_path, monkeypatch):
    """The kernel is in a folder of its own: beside this file, an earlier test run has left it in the cache."""
    code = "from sfm_app.jit import kernel\n\n@kernel\ndef thrice(x):\n    return 3 * x\n"
    (tmp_path / "waited_for.py").write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    thrice, seen = importlib.import_module("waited_for").thrice, []

    def is_awaited(name, signature):
        seen.append((name.rpartition(".")[2], is_waiting()))
        return len(seen) < 3

    wait_where(is_awaited)
    try:
        assert thrice(2.0) == 6.0
    finally:
        wait_where(None)
    assert seen == [("thrice", True)] * 3 and not is_waiting()
