"""A whole run on a system that lacks every ability: the same bytes, and nothing that Windows would refuse."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sfm_app.operating_system import VARIABLE, Ability, lacks

RULES = Path(__file__).with_name("rules_of_windows")
QUICK = (
    "--quality",
    "draft",
    "--set",
    "depth.max_image_size_px=160",
    "--set",
    "matching.max_image_size_px=320",
    "--faces",
    "3000",
    "--workers",
    "2",
)
TIMES = {"manifest.json", "log.txt", "report.html", "database.db"}
"""Files that hold times, or in which SQLite counts its changes."""
RESERVED = re.compile(r'[<>:"\\|?*\x00-\x1f]|[. ]$|^(?:con|prn|aux|nul|com\d|lpt\d)(?:\.|$)', re.IGNORECASE)
"""Names that Windows does not have."""


def rules_for(out, notes):
    """Variables with which Python notes what Windows would refuse below a folder."""
    paths = os.pathsep.join([str(RULES), os.environ.get("PYTHONPATH", "")])
    return {"RULES_OUT": str(out.resolve()), "RULES_NOTES": str(notes), "PYTHONPATH": paths}


def call(photos, out, **environment):
    command = [sys.executable, "-X", "warn_default_encoding", "-m", "sfm_app", "run", photos, "-o", out, *QUICK]
    known = {**os.environ, **environment}
    return subprocess.run(command, env=known, capture_output=True, encoding="utf-8", check=False)


@pytest.fixture(scope="module")
def runs(rendered, tmp_path_factory):
    """The output folders of a run as ever, and of one without any ability; what the latter said, and what was noted."""
    place = tmp_path_factory.mktemp("systems").resolve()
    photos = place / "photos"
    photos.mkdir()
    for path in sorted(rendered[0].glob("*.jpg"))[:4]:
        shutil.copy(path, photos)
    usual, bare, notes = place / "usual", place / "bare", place / "notes.txt"
    done = call(photos, usual)
    assert done.returncode == 0, done.stderr
    done = call(photos, bare, **{VARIABLE: ",".join(Ability)}, **rules_for(bare, notes))
    assert done.returncode == 0, done.stderr
    return usual, bare, done, notes


def files(out):
    """All files by name, with what they hold; links are followed."""
    names = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    return {name: (out / name).read_bytes() for name in names if name not in TIMES}


def test_every_file_has_the_same_bytes(runs):
    usual, bare = files(runs[0]), files(runs[1])
    assert len(usual) > 30 and {"model.glb", "photos.json", "scene.json"} < usual.keys()
    assert [name for name in {**usual, **bare} if usual.get(name) != bare.get(name)] == []


@pytest.mark.skipif(lacks(Ability.LINKS) or os.name == "nt", reason="this system has no links")
def test_photos_are_links_and_copies(runs):
    usual, bare = ([path.is_symlink() for path in sorted((out / "photos").iterdir())] for out in runs[:2])
    assert all(usual) and len(usual) == 4 and not any(bare) and len(bare) == 4


def test_stages_have_the_same_results(runs):
    usual, bare = (json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"] for out in runs[:2])
    for name, record in usual.items():
        for key in ("fingerprint", "digest", "files", "made_with"):
            assert record[key] == bare[name][key], f"{name}: {key}"
        assert bare[name]["cpu_seconds"] >= 0 and bare[name]["peak_mb"] > 100


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="only Linux tells which files are open")
def test_nothing_that_is_open_is_removed_replaced_or_moved(runs):
    assert not runs[3].exists(), runs[3].read_text(encoding="utf-8")


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="only Linux tells which files are open")
def test_exports_remove_nothing_that_is_open(runs, tmp_path):
    """All in one process, in which a file that an export leaves open is open still when the next replaces it."""
    files = {"usdz": "x.usdz", "colmap": "colmap", "bundler": "bundler", "draco": "x.glb", "laz": "x.laz"}
    targets, notes = {name: tmp_path / file for name, file in files.items()}, tmp_path / "notes.txt"
    calls = [["export", str(runs[0]), "--format", name, "-o", str(target)] for name, target in targets.items()]
    code = f"from sfm_app.cli.program import main\nfor call in 2 * {calls!r}:\n  main(call, standalone_mode=False)"

    known = {**os.environ, **rules_for(tmp_path, notes), "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=known, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [name for name, target in targets.items() if not target.exists()] == []
    assert not notes.exists(), notes.read_text(encoding="utf-8")


def test_no_text_is_read_or_written_as_this_machine_is_set(runs):
    warned = re.findall(r"^.*sfm_app.*EncodingWarning.*$", runs[2].stderr, re.MULTILINE)
    assert warned == []


def test_windows_could_have_every_name(runs):
    names = [path.relative_to(runs[1]).as_posix() for path in runs[1].rglob("*")]
    assert [name for name in names if any(RESERVED.search(part) for part in name.split("/"))] == []
    assert len({name.casefold() for name in names}) == len(names) and max(map(len, names)) < 100


def test_a_run_goes_on_from_copies(runs):
    model = (runs[1] / "model.glb").stat().st_mtime_ns
    done = call(runs[0].with_name("photos"), runs[1], **{VARIABLE: ",".join(Ability)})
    assert done.returncode == 0, done.stderr
    assert (runs[1] / "model.glb").stat().st_mtime_ns == model


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="only Linux tells which files are open")
def test_the_rules_of_windows_are_noticed(tmp_path):
    code = (
        "import os\nfrom pathlib import Path\nout = Path(os.environ['RULES_OUT']); inner = out / 'in'; inner.mkdir()\n"
        "(inner / 'a').write_text('x'); (inner / 'b').write_text('y'); (inner / 'b').unlink()\n"
        "with (inner / 'a').open():\n  inner.rename(out / 'moved')\n"
    )
    notes = tmp_path / "notes.txt"
    subprocess.run([sys.executable, "-c", code], env={**os.environ, **rules_for(tmp_path, notes)}, check=True)
    (line,) = [line for line in notes.read_text(encoding="utf-8").splitlines() if line.startswith(("re", "un"))]
    assert line.startswith("rename") and "in/a" in line
