import os
import subprocess
import sys
from importlib.metadata import version

import numba
import numpy as np
import pytest

from sfm_app.jit import kernel, summing_kernel

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
