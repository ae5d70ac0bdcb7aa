"""The process that compiles kernels beside the first run."""

import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from sfm_app.engine import warm_up
from sfm_app.engine.warm_up import PARENT, warming_up
from sfm_app.progress import SilentProgress

HANGS_S = 600


@pytest.fixture
def cold(tmp_path, monkeypatch):
    """A machine on which no kernel is compiled; the file that says so once they are."""
    monkeypatch.setattr(warm_up, "WARM", tmp_path / "cache" / "warm")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv(PARENT, raising=False)
    return tmp_path / "cache" / "warm"


def compilers():
    return [one for one in psutil.Process().children() if "sfm_app.warm_up" in one.cmdline()]


def test_kernels_are_compiled_while_the_block_lasts(cold):
    with warming_up(SilentProgress()):
        until = time.monotonic() + HANGS_S
        while not compilers() and time.monotonic() < until:  # the arguments of a new process can be read a moment later
            time.sleep(0.01)
        (process,) = compilers()
        folder = Path(process.cmdline()[-1])
        assert folder.is_dir()

    assert not compilers() and not folder.exists()


def test_nothing_is_compiled_where_that_has_been_done(cold):
    cold.parent.mkdir()
    cold.touch()

    with warming_up(SilentProgress()):
        assert not compilers()


def test_the_process_starts_no_other(cold, monkeypatch):
    monkeypatch.setenv(PARENT, "1")

    with warming_up(SilentProgress()):
        assert not compilers()


@pytest.mark.slow
def test_all_stages_are_compiled(tmp_path):
    """With the cache of the other tests: only the file that says that all is compiled is elsewhere."""
    code = (
        "import pathlib, sys; from sfm_app import jit; jit.WARM = pathlib.Path(sys.argv[1]) / 'cache' / 'warm'; "
        "from sfm_app import warm_up; warm_up.main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False, timeout=HANGS_S
    )

    assert done.returncode == 0, done.stderr
    assert (tmp_path / "model" / "model.glb").exists() and (tmp_path / "cache" / "warm").exists()
