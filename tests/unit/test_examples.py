"""Every example runs as it stands."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[2] / "examples"


def call(name, *arguments):
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def folder_run(rendered, tmp_path_factory):
    """The output folder of examples/reconstruct_folder.py, and what it said."""
    out = tmp_path_factory.mktemp("example") / "out"
    return out, call("reconstruct_folder.py", rendered[0], out)


def test_one_estimator():
    done = call("one_estimator.py")

    assert done.returncode == 0, done.stderr
    assert "identifiable: True" in done.stdout


def test_reconstruct_folder(folder_run):
    out, done = folder_run

    assert done.returncode == 0, done.stderr
    assert "7 photos placed" in done.stdout
    assert (out / "model.glb").exists()


def test_export_model(folder_run, tmp_path):
    done = call("export_model.py", folder_run[0], tmp_path / "files")

    assert done.returncode == 0, done.stderr
    names = {path.name for path in (tmp_path / "files").iterdir()}
    assert {"model.obj", "model.mtl", "points.ply"} < names and any(name.endswith(".jpg") for name in names)
    assert {line.split(":")[0] for line in done.stdout.splitlines()} == names
