"""Libraries that Open3D lacks."""

import importlib

import pytest

from sfm_app.errors import SfmError
from sfm_app.meshing.ray_casting import load_open3d


@pytest.mark.parametrize(
    ("message", "hint"),
    [
        ("libGL.so.1: cannot open shared object file: No such file or directory", "install libgl1"),
        ("libidn2.so.0: cannot open shared object file: No such file or directory", "install libidn2-0"),
        ("libnew.so.3: cannot open shared object file: No such file or directory", "libegl1 libgl1"),
    ],
)
def test_a_library_that_is_missing_is_named_with_its_package(monkeypatch, message, hint):
    real = importlib.import_module

    def fail(name, *arguments):
        if name == "open3d":
            raise ImportError(message)
        return real(name, *arguments)

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.raises(SfmError, match="cannot be loaded") as caught:
        load_open3d.__wrapped__()

    assert message in str(caught.value) and hint in caught.value.hint
