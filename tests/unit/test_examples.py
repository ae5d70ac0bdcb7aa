"""Every example runs as it stands."""

import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"


def call(name, *arguments):
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_one_estimator():
    done = call("one_estimator.py")

    assert done.returncode == 0, done.stderr
    assert "identifiable: True" in done.stdout


def test_reconstruct_folder(rendered, tmp_path):
    done = call("reconstruct_folder.py", rendered[0], tmp_path / "out")

    assert done.returncode == 0, done.stderr
    assert "7 photos placed" in done.stdout
    assert (tmp_path / "out" / "model.glb").exists()
