"""A small folder of photos, and what a run that nobody disturbed makes of it."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from sfm_app.synthetic.cameras import ArcOptions, arc, make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder
from sfm_app.synthetic.scenes import build_scene

QUICK = ("--quality", "draft", "--set", "depth.max_image_size_px=240", "--faces", "3000", "-q", "--workers", "2")


@dataclass(frozen=True)
class Folder:
    """Photos, and the files of an undisturbed run."""

    photos: Path
    out: Path
    appeared: int
    """How many files of the run appeared, one after the other."""

    def result(self, out: Path) -> dict[str, bytes]:
        """What has to be the same byte for byte."""
        names = ["view_graph.npz", "calibration.json", "model.glb", "model.ply"]
        names += [f"sparse/{part}.bin" for part in ("cameras", "images", "points3D")]
        return {name: (out / name).read_bytes() for name in names}

    def command(self, out: Path) -> list[str]:
        """Arguments of `sfm-app`."""
        return ["run", str(self.photos), "-o", str(out), *QUICK]

    def run(self, out: Path, point: str = "count") -> "subprocess.CompletedProcess[str]":
        """`sfm-app run` in a process of its own, killed at a point."""
        script = Path(__file__).with_name("killed.py")
        command = [sys.executable, str(script), point, *self.command(out)]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    place = tmp_path_factory.mktemp("faults")
    views = arc(make_camera(480, 360), ArcOptions(photos=5, sweep_deg=40.0))
    write_photo_folder(place / "photos", build_scene(), views, PhotoOptions(supersampling=1))
    done = Folder(place / "photos", place / "out", 0).run(place / "out")
    assert done.returncode == 0, done.stderr
    return Folder(place / "photos", place / "out", int(done.stdout.split()[-1]))
