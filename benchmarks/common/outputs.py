"""The cameras in the output folder of a run."""

import json
from pathlib import Path
from typing import Any, NamedTuple


class Cameras(NamedTuple):
    """Cameras by name, and names of cameras by photo."""

    cameras: dict[str, Any]
    camera_of: dict[str, str]


def read_initial_cameras(out: Path) -> Cameras:
    """Read the cameras before mapping; empty where the run did not get that far."""
    return _read(out / "calibration.json")


def read_refined_cameras(out: Path) -> Cameras:
    """Read the cameras after bundle adjustment; empty where the run did not get that far."""
    return _read(out / "scene.json")


def _read(path: Path) -> Cameras:
    found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"cameras": {}, "camera_of": {}}
    return Cameras(found["cameras"], found["camera_of"])
