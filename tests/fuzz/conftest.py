"""A small finished run, and what must not change while damaged files are read."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest
from click.testing import CliRunner

from sfm_app.cli.program import main
from sfm_app.synthetic.cameras import ArcOptions, arc, make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder
from sfm_app.synthetic.scenes import courtyard

QUICK = (
    "--quality", "draft", "--set", "depth.max_image_size_px=160", "--set", "matching.max_image_size_px=320",
    "--faces", "1000", "-q", "--workers", "2",
)  # fmt: skip


@dataclass(frozen=True)
class Finished:
    """Photos and what a run made of them; a copy, so that tests can damage it."""

    place: Path
    """The folder that holds both, and a file that is nobody's business."""

    @property
    def photos(self) -> Path:
        return self.place / "photos"

    @property
    def out(self) -> Path:
        return self.place / "out"

    def run(self, *flags):
        """`sfm-app run`, once more."""
        return CliRunner().invoke(main, ["run", str(self.photos), "-o", str(self.out), *QUICK, *flags])

    def outside(self):
        """Bytes of all files that a run must leave alone."""
        files = [self.place / "secret.jpg", *self.photos.rglob("*"), *self.place.glob("*")]
        return {path: path.read_bytes() if path.is_file() else None for path in files}


@pytest.fixture(scope="session")
def photos(tmp_path_factory):
    """Four photos of a courtyard."""
    folder = tmp_path_factory.mktemp("fuzz") / "photos"
    views = arc(make_camera(400, 300), ArcOptions(photos=4, sweep_deg=30.0))
    write_photo_folder(folder, courtyard(), views, PhotoOptions(supersampling=1))
    return folder


@pytest.fixture(scope="session")
def made(photos):
    found = Finished(photos.parent)
    shutil.copy(photos / "view_00.jpg", found.place / "secret.jpg")
    result = found.run()
    assert result.exit_code == 0, result.stderr
    return found


@pytest.fixture
def kept(made, tmp_path):
    """Put back whatever a test does to the run."""
    shutil.copytree(made.place, tmp_path / "whole", symlinks=True)
    yield made
    shutil.rmtree(made.place)
    shutil.copytree(tmp_path / "whole", made.place, symlinks=True)
