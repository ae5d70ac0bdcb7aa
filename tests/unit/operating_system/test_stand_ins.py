"""Stand-ins for libraries that Open3D links to, on a machine without a screen."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from sfm_app.meshing.open3d import LINKED
from sfm_app.operating_system import stand_ins

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the wheels of Open3D need none")

CAST_A_RAY = """
from sfm_app.operating_system import stand_ins
stand_ins._is_there = lambda name: False
from sfm_app.meshing.open3d import load_open3d
import numpy as np
open3d = load_open3d()
scene = open3d.t.geometry.RaycastingScene()
corners = np.array([[0, 0, 2], [1, 0, 2], [0, 1, 2]], np.float32)
scene.add_triangles(open3d.core.Tensor(corners), open3d.core.Tensor(np.array([[0, 1, 2]], np.uint32)))
ray = open3d.core.Tensor([[0.2, 0.2, 0, 0, 0, 1]], dtype=open3d.core.float32)
print(float(scene.cast_rays(ray)["t_hit"][0].item()))
with open("/proc/self/maps") as maps:
    print(*sorted({line.split("/memfd:")[1].split()[0] for line in maps if "/memfd:lib" in line}))
"""


CALL = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
print(*(getattr(library, name)(5) for name in sys.argv[2:]), hasattr(library, "fourth"))
"""


def open3d_library() -> Path:
    spec = importlib.util.find_spec("open3d")
    assert spec is not None and spec.origin is not None
    return next(path for pattern in LINKED for path in Path(spec.origin).parent.glob(pattern))


def test_open3d_needs_what_is_listed():
    processor, needed, undefined = stand_ins.read_needs(open3d_library())
    assert processor in stand_ins.RETURN_0
    assert {"libGL.so.1", "libX11.so.6"} <= set(needed) & set(stand_ins.PREFIXES)
    assert {"glClear", "XFlush", "malloc"} <= set(undefined)
    unknown = set(needed) - set(stand_ins.PREFIXES)
    assert all(name.startswith(("libtbb", "libstdc++", "libgcc_s", "libm.", "libc.", "ld-linux")) for name in unknown)


@pytest.mark.parametrize("functions", [[], ["first"], ["first", "second", "third"]])
@pytest.mark.parametrize("name", ["libnothing.so.7", "libudev.so.1"])
def test_functions_of_a_stand_in_return_0(name, functions, tmp_path):
    processor = stand_ins.read_needs(open3d_library())[0]
    path = tmp_path / "any.so"
    path.write_bytes(stand_ins.make_stand_in(name, functions, processor))
    # in a process of its own: what this one loads next would get the stand-in for the library of that name
    done = subprocess.run([sys.executable, "-c", CALL, path, *functions], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0"] * len(functions) + ["False"]


def test_rays_are_cast_without_any_library_of_the_system():
    done = subprocess.run([sys.executable, "-c", CAST_A_RAY], capture_output=True, text=True, check=True)
    distance, loaded = done.stdout.splitlines()
    assert float(distance) == pytest.approx(2.0, rel=1e-5)
    assert {"libGL.so.1", "libX11.so.6"} <= set(loaded.split()) <= set(stand_ins.PREFIXES)


def test_what_is_there_is_not_replaced(monkeypatch):
    monkeypatch.setattr(stand_ins, "_is_there", bool)
    assert stand_ins.add_stand_ins(open3d_library()) == []


def test_other_processors_get_none(monkeypatch):
    monkeypatch.setattr(stand_ins, "RETURN_0", {})
    monkeypatch.setattr(stand_ins, "_is_there", lambda _: False)
    assert stand_ins.add_stand_ins(open3d_library()) == []
