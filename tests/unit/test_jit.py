"""Compilation of kernels, in this process and in one beside the first run."""

import os
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numba
import numpy as np
import psutil
import pytest

from sfm_app.jit import PARENT, inlined_kernel, kernel, summing_kernel, warming_up

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("decorator", [inlined_kernel, kernel, summing_kernel])
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
        result = 0.0
        for k in range(values.shape[0]):
            result += values[k]
        return result

    values = np.random.default_rng(0).normal(size=1001)
    assert total(values) == pytest.approx(values.sum(), rel=1e-12)
    values[500] = np.inf
    assert total(values) == np.inf
    values[0] = -np.inf
    assert np.isnan(total(values))


def test_kernels_are_cached_in_a_folder_of_this_version(tmp_path):
    """Numba cannot read a cache that names a class which an upgrade has removed."""
    (tmp_path / "module.py").write_text(
        "from sfm_app.jit import kernel\n\n@kernel\ndef twice(x):\n    return 2 * x\n\nprint(twice(21))\n",
        encoding="utf-8",
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-c", "import module"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.returncode) == ("42", 0), done.stderr
    assert [path.name for path in (tmp_path / "cache").iterdir()] == [f"kernels-{version('sfm-app')}"]
    assert len(list(tmp_path.rglob("module.twice*.nbi"))) == 1


def test_the_cache_of_other_functions_stays_where_it_is():
    assert os.environ.get("NUMBA_CACHE_DIR", "") == numba.config.CACHE_DIR


HANGS_S = 600


@pytest.fixture
def cold(tmp_path, monkeypatch):
    """The missing marker of compiled kernels, on a machine without any."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv(PARENT, raising=False)
    return tmp_path / "cache" / "warm"


def compilers():
    return [one for one in psutil.Process().children() if "sfm_app.warm_up" in one.cmdline()]


def test_kernels_are_compiled_while_the_block_lasts(cold):
    with warming_up([].append, cold):
        until = time.monotonic() + HANGS_S
        while not compilers() and time.monotonic() < until:  # the arguments of a new process can be read a moment later
            time.sleep(0.01)
        (process,) = compilers()
        folder = Path(process.cmdline()[-1])
        assert folder.is_dir()
    assert not compilers() and not folder.exists()


def test_compiled_kernels_are_not_compiled_again(cold):
    cold.parent.mkdir()
    cold.touch()
    with warming_up([].append, cold):
        assert not compilers()


def test_the_process_starts_no_other(cold, monkeypatch):
    monkeypatch.setenv(PARENT, "1")
    with warming_up([].append, cold):
        assert not compilers()


@pytest.mark.slow
def test_all_stages_are_compiled(tmp_path):
    """With the cache of the other tests: only the file that says that all is compiled is elsewhere."""
    code = (
        "import pathlib, sys; from sfm_app import jit; jit.WARM = pathlib.Path(sys.argv[1]) / 'cache' / 'warm'; "
        "from sfm_app import warm_up; warm_up.main()"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    environment = {name: value for name, value in os.environ.items() if name != PARENT}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=HANGS_S)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "model" / "model.glb").exists() and (tmp_path / "cache" / "warm").exists()
