import contextlib
import json
import os
import pkgutil
import subprocess
import sys
import threading
from pathlib import Path

import numba
import numpy as np
import psutil
import pytest
from numba import types

from sfm_app import jit
from sfm_app.progress import SilentProgress
from sfm_app.runtime import compiling
from sfm_app.runtime.compiling import PARTS, compile_part, compiling_ahead, describe, make_type, read_list, stamp_file

MODULE = """
from sfm_app.jit import kernel

@kernel
def twice(values):
    return 2.0 * values

@kernel
def thrice(values):
    return 3.0 * values
"""


class Listener(SilentProgress):
    def __init__(self):
        self.heard = []

    def say(self, text):
        self.heard.append(text)


@pytest.fixture
def listed(tmp_path, monkeypatch):
    """A list of two kernels of a module of its own, with a cache of its own."""
    (tmp_path / "few_kernels.py").write_text(MODULE)
    kernels = {"few_kernels.twice": [["float64[1C]"]], "few_kernels.thrice": [["float64"]]}
    (tmp_path / "kernels.json").write_text(json.dumps({"cameras": kernels, "surface": kernels}))
    monkeypatch.setattr(compiling, "LIST", tmp_path / "kernels.json")
    monkeypatch.syspath_prepend(str(tmp_path))
    read_list.cache_clear()
    yield tmp_path
    read_list.cache_clear()
    sys.modules.pop("few_kernels", None)


@pytest.mark.parametrize(
    "value",
    [
        2.5, 3, True, np.zeros(3), np.zeros((2, 3), np.float32), np.zeros((4, 3, 2), order="F"), np.zeros(9)[::2],
        (1.0, 2.0), (1, 2.0, np.zeros(2, np.uint8)), (np.zeros(2), (True, 1j)), np.arange(3, dtype=np.uint32),
    ],
)  # fmt: skip
def test_types_are_found_again_from_their_description(value):
    kind = numba.typeof(value)

    assert make_type(json.loads(json.dumps(describe(kind)))) == kind


def test_an_array_that_cannot_be_written_is_another_type():
    fixed = np.zeros(3)
    fixed.flags.writeable = False

    assert describe(numba.typeof(fixed)) == "float64[1C!]"
    assert make_type("float64[1C!]") == numba.typeof(fixed) != numba.typeof(np.zeros(3))


@pytest.mark.parametrize("part", PARTS)
def test_every_listed_kernel_is_there_with_types_that_exist(part):
    kernels = read_list()[part]

    assert len(kernels) > 10
    for name, signatures in kernels.items():
        assert pkgutil.resolve_name(name).py_func.__name__ == name.rpartition(".")[2]
        for kinds in signatures:
            assert all(isinstance(make_type(kind), types.Type) for kind in kinds)


OPTIONAL = {"_drop_masked", "texel_frames", "encode"}
"""Kernels for masks and normal maps, which few runs need."""


def test_every_kernel_of_the_surface_is_listed():
    """Except for those that others call; one that is forgotten stops the first run on a machine."""
    found = {}
    for room in ("stereo", "meshing", "texture"):
        package = pkgutil.resolve_name(f"sfm_app.{room}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            for name, kernel in vars(pkgutil.resolve_name(module.name)).items():
                function = getattr(kernel, "py_func", None)
                if getattr(function, "__module__", None) == module.name:
                    found[f"{module.name}.{name}"] = function
    assert len(found) > 40
    called = {name for function in found.values() for name in function.__code__.co_names}
    listed = {name for part in PARTS for name in read_list()[part]}

    assert {name.split(".")[-1] for name in found.keys() - listed} - called == OPTIONAL


def test_compiling_a_part_leaves_a_stamp_that_a_changed_source_takes_away(listed):
    before = stamp_file("cameras")

    assert not before.exists()
    assert compile_part("cameras") == []
    assert stamp_file("cameras").exists()
    assert not stamp_file("surface").exists()
    os.utime(listed / "kernels.json")  # only what it says counts
    assert stamp_file("cameras").exists()
    (listed / "kernels.json").write_text((listed / "kernels.json").read_text().replace("float64", "float32"))
    read_list.cache_clear()
    assert not stamp_file("cameras").exists()
    assert compile_part("cameras") == []
    assert len(list(before.parent.glob("compiled-cameras-*"))) == 1


def test_a_kernel_that_cannot_be_compiled_does_not_stop_the_others(listed):
    kernels = {"few_kernels.lost": [["float64"]], "few_kernels.twice": [["float64"], ["nonsense"]]}
    (listed / "kernels.json").write_text(json.dumps({"cameras": {"few_kernels.twice": [["float64"]], **kernels}}))
    read_list.cache_clear()

    failed = compile_part("cameras")

    assert [line.split(":")[0] for line in failed] == ["few_kernels.twice", "few_kernels.lost"]
    assert stamp_file("cameras").exists()


def test_nothing_is_started_where_all_is_compiled(listed, monkeypatch):
    compile_part("cameras")
    monkeypatch.setattr(compiling, "_start", lambda part: pytest.fail(f"{part} was started"))
    progress = Listener()

    with compiling_ahead(["cameras"], progress):
        assert jit._Waiting.is_awaited is None

    assert progress.heard == []


def test_a_kernel_is_taken_from_the_process_that_compiles_it(listed, monkeypatch):
    go = listed / "go"
    code = f"""
import sys, time
from pathlib import Path
sys.path.insert(0, {str(listed)!r})
while not Path({str(go)!r}).exists():
    time.sleep(0.02)
from numba import types
import few_kernels
few_kernels.twice.compile((types.Array(types.float64, 1, "C"),))
time.sleep(60)
"""
    monkeypatch.setattr(compiling, "_start", lambda _: subprocess.Popen([sys.executable, "-c", code]))
    progress, found = Listener(), []

    with compiling_ahead(["cameras"], progress):
        import few_kernels

        assert few_kernels.thrice(2) == 6.0  # of other types than listed: compiled here, at once
        waiting = threading.Thread(target=lambda: found.append(few_kernels.twice(np.ones(2))))
        waiting.start()
        waiting.join(0.5)
        assert found == []
        go.touch()
        waiting.join(60)
        assert found[0].tolist() == [2.0, 2.0]
        assert sum(few_kernels.twice.stats.cache_hits.values()) == 1

    assert len(progress.heard) == 1
    assert jit._Waiting.is_awaited is None


def test_whoever_needs_a_kernel_of_a_run_that_has_ended_ends_with_it(listed, monkeypatch):
    idle = "import time; time.sleep(60)"
    monkeypatch.setattr(compiling, "_start", lambda _: subprocess.Popen([sys.executable, "-c", idle]))
    failed = []

    def call():
        try:
            few_kernels.twice(np.ones(2))
        except InterruptedError as err:
            failed.append(str(err))

    with compiling_ahead(["cameras"], Listener()) as has_ended:
        import few_kernels

        waiting = threading.Thread(target=call)
        waiting.start()
        waiting.join(0.5)
        assert waiting.is_alive()
        has_ended.set()
        waiting.join(5)
        call()
        assert failed == ["the run has ended", "the run has ended"]
    assert few_kernels.twice(np.ones(2)).tolist() == [2.0, 2.0]


def test_no_process_is_left_behind(listed):
    code = """
import os, sys
from sfm_app.progress import SilentProgress
from sfm_app.runtime import compiling
start = compiling._start
def tell(part):
    found = start(part)
    print(found.pid, flush=True)
    return found
compiling._start = tell
with compiling.compiling_ahead(["cameras"], SilentProgress()):
    os.kill(os.getpid(), 9)
"""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(listed / "cache")}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)

    assert done.returncode == -9
    with contextlib.suppress(psutil.NoSuchProcess):
        psutil.Process(int(done.stdout)).wait(12)  # it would compile for twice as long


def test_a_process_that_dies_is_not_waited_for(listed, monkeypatch):
    monkeypatch.setattr(compiling, "_start", lambda _: subprocess.Popen([sys.executable, "-c", "1/0"], stderr=-3))

    with compiling_ahead(["cameras"], Listener()):
        import few_kernels

        assert few_kernels.twice(np.ones(2)).tolist() == [2.0, 2.0]
    assert not stamp_file("cameras").exists()


def test_the_process_compiles_what_is_listed(listed):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(listed / "cache")}
    code = f"""
import sys
sys.path.insert(0, {str(listed)!r})
from pathlib import Path
from sfm_app.runtime import compiling
compiling.LIST = Path({str(listed / "kernels.json")!r})
print(compiling.compile_part("surface"))
import few_kernels, numpy
few_kernels.twice(numpy.ones(3)), few_kernels.thrice(1.0)
print(compiling.used_kernels()["cameras"])
"""
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)

    said = done.stdout.splitlines()
    assert said[0] == "[]"
    assert Path(listed / "cache").is_dir()
    assert "few_kernels.twice" in said[1] and "few_kernels.thrice" in said[1]
