"""Several inputs are gathered into one folder, whatever their order; bad archives are refused in words."""

import zipfile
from contextlib import suppress

import numpy as np
import pytest
from PIL import Image

from sfm_app.api import reconstruct
from sfm_app.errors import SfmError
from sfm_app.photos.gather import expand, gather
from sfm_app.settings import Settings


@pytest.fixture
def archive(tmp_path):
    place = tmp_path / "z.zip"
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("in/a.jpg", b"a photo")
        packed.writestr("__MACOSX/in/._a.jpg", b"copy")
    return place


def gathered(inputs, target):
    gather(expand(inputs), target, target.parent)
    return {path.relative_to(target).as_posix(): path.read_bytes() for path in target.rglob("*") if path.is_file()}


def test_files_wildcards_folders_and_archives_in_any_order(tmp_path, archive):
    for name in ("p/a.jpg", "q/a.jpg", "r/c.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(name.encode())
    inputs = [tmp_path / "p" / "*.jpg", tmp_path / "q" / "a.jpg", tmp_path / "r", archive]
    found = gathered(inputs, tmp_path / "out" / "inputs")
    assert found == {"a.jpg": b"p/a.jpg", "_a.jpg": b"q/a.jpg", "r/c.jpg": b"r/c.jpg", "z/in/a.jpg": b"a photo"}
    assert gathered(inputs[::-1], tmp_path / "out" / "inputs") == found


@pytest.mark.parametrize(("name", "content"), [("../x.jpg", b"x"), ("x.jpg", bytes(10**6))])
def test_archives_that_lead_out_or_explode_are_refused(tmp_path, name, content):
    with zipfile.ZipFile(tmp_path / "z.zip", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr(name, content)
    with pytest.raises(SfmError, match=r"leads out|too many"):
        gathered([tmp_path / "z.zip"], tmp_path / "out" / "inputs")


def test_damaged_archives_raise_named_errors_only(tmp_path, archive):
    data, rng = archive.read_bytes(), np.random.default_rng(0)
    for _ in range(200):
        damaged = bytearray(data)
        damaged[rng.integers(len(data))] = rng.integers(256)
        archive.write_bytes(damaged)
        with suppress(SfmError):
            gathered([archive], tmp_path / "out" / "inputs")


def test_a_run_takes_several_inputs_and_resumes_in_any_order(tmp_path):
    for name in "ab":
        rng = np.random.default_rng(ord(name))
        small = Image.fromarray(rng.integers(0, 255, (12, 16, 3), np.uint8))
        small.resize((128, 96), Image.Resampling.BICUBIC).save(tmp_path / f"{name}.png")
    inputs = [tmp_path / "a.png", tmp_path / "b.png"]
    first = reconstruct(inputs, tmp_path / "out", Settings(workers=1), last="photos").manifest["stages"]
    written = (tmp_path / "out" / "photos.json").stat().st_mtime_ns
    again = reconstruct(inputs[::-1], tmp_path / "out", Settings(workers=1), last="photos").manifest["stages"]
    assert again == first
    assert (tmp_path / "out" / "photos.json").stat().st_mtime_ns == written
