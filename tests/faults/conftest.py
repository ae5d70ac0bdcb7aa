"""A small folder of photos, and what a run that nobody disturbed makes of it."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from sfm_app.synthetic.cameras import ArcOptions, arc, make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder
from sfm_app.synthetic.scenes import courtyard

QUICK = ["--quality", "draft", "--set", "depth.max_image_size_px=240", "--faces", "3000", "-q", "--workers", "2"]
if "SFM_APP_FAULTS" not in os.environ:  # half of a run, thirty times
    QUICK += ["--set", "report=false", "--set", "matching.enlarge_below=100", "--set", "matching.max_image_size_px=320"]
    QUICK += ["--set", "depth.max_image_size_px=160", "--faces", "1000"]


def cases(all_of_them, always):
    """Parameters of which `make test` tries some, and `make faults` all."""
    mark = pytest.mark.skipif("SFM_APP_FAULTS" not in os.environ, reason="`make faults` tries all of them")
    values = [(one, one if isinstance(one, tuple) else (one,)) for one in all_of_them]
    return [pytest.param(*each, marks=() if one in always else mark) for one, each in values]


@dataclass(frozen=True)
class Folder:
    """Photos, and the files of an undisturbed run."""

    photos: Path
    out: Path
    start: Callable[..., "subprocess.CompletedProcess[str]"]
    """Runs Python."""
    appeared: int = 0
    """How many files of the run appeared, one after the other."""

    def result(self, out: Path) -> dict[str, bytes]:
        """What has to be the same byte for byte."""
        names = ["view_graph.npz", "calibration.json", "scene.json", "model.glb", "model.ply"]
        names += [f"sparse/{part}.bin" for part in ("cameras", "images", "points3D")]
        return {name: (out / name).read_bytes() for name in names}

    def run(self, out: Path, what: str = "kill", moment: str = "never") -> "subprocess.CompletedProcess[str]":
        """`sfm-app run` in a process of its own, disturbed at a moment."""
        script = Path(__file__).with_name("disturbed.py")
        return self.start(script, what, moment, "run", self.photos, "-o", out, *QUICK)

    def finish(self, out: Path) -> None:
        """Run again, and check that all is as in the undisturbed run."""
        again = self.run(out)
        assert again.returncode == 0, again.stderr
        assert self.result(out) == self.result(self.out)

    def copied(self, place: Path) -> "Folder":
        """The same photos in a place where they may be spoilt."""
        shutil.copytree(self.photos, place / "photos")
        return replace(self, photos=place / "photos")

    def moment(self, share: float) -> int:
        """The number of the file that appears after this share of all."""
        return 1 + round(share * (self.appeared - 1))


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory, as_ordinary_user):
    if sys.platform == "win32":
        pytest.skip("Windows has neither SIGKILL nor limits of processes")
    place = tmp_path_factory.mktemp("faults")
    views = arc(make_camera(400, 300), ArcOptions(photos=4, sweep_deg=32.0))
    write_photo_folder(place / "photos", courtyard(), views, PhotoOptions(supersampling=1))
    folder = Folder(place / "photos", place / "out", as_ordinary_user)
    done = folder.run(place / "out")
    assert done.returncode == 0, done.stderr
    return replace(folder, appeared=int(done.stdout.split()[-1]))


@pytest.fixture
def refused():
    """Checks that a run ended with one line and a hint, and with nothing that users should not see."""

    def check(done, *codes):
        assert done.returncode in codes, done.stderr
        lines = done.stderr.strip().splitlines()
        assert len(lines) == 2 and lines[0].startswith("error: ") and lines[1].startswith("hint: "), done.stderr

    return check
