"""Nothing that is read is run, nothing goes to the network, and names are nothing but names."""

import ast
import contextlib
import json
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

import sfm_app
from sfm_app.cli.program import main

from .conftest import QUICK

SOURCES = sorted(Path(sfm_app.__file__).parent.rglob("*.py"))
CODE_OR_NETWORK = {
    "pickle", "cPickle", "dill", "joblib", "marshal", "shelve", "code", "runpy",
    "socket", "ssl", "http", "urllib", "ftplib", "smtplib", "requests", "httpx", "aiohttp",
}  # fmt: skip
UNPICKLES_WHAT_IT_SENT = Path(sfm_app.__file__).parent / "runtime/cluster.py"
"""Checks hashes that come with the messages of a cluster."""
CALLS_ITS_OWN_PROCESS = Path(sfm_app.__file__).parent / "colmap/worker_process.py"
"""Sends calls to a process that it started, through a pipe, and takes their results."""
SERVES_MODELS = Path(sfm_app.__file__).parent / "report/server.py"
"""Listens on 127.0.0.1, or where the user says, to those who have the token."""
SERVES_PROJECTS = Path(sfm_app.__file__).parent / "studio/server.py"
"""As above."""
KNOWN = {
    UNPICKLES_WHAT_IT_SENT: ["imports pickle"],
    CALLS_ITS_OWN_PROCESS: ["imports pickle"],
    SERVES_MODELS: ["imports socket", "imports http", "imports http.server", "imports urllib.parse"],
    SERVES_PROJECTS: ["imports socket", "imports urllib.parse"],
}
RUNS_TEXT = {"eval", "exec", "compile", "__import__", "breakpoint", "os.system", "os.popen", "os.startfile"}


def doubts(source):
    """What in a module could run what it reads, or reach the network."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            yield from (f"imports {name}" for name in names if name.split(".")[0] in CODE_OR_NETWORK)
        elif isinstance(node, ast.Call):
            yield from _doubts_of_call(ast.unparse(node.func), {k.arg: ast.unparse(k.value) for k in node.keywords})


def _doubts_of_call(name, options):
    if name in RUNS_TEXT or name.startswith(("os.exec", "os.spawn")):
        yield f"calls {name}"
    if options.get("shell", "False") != "False":
        yield f"{name} with a shell"
    if name in ("np.load", "numpy.load") and options.get("allow_pickle") != "False":
        yield f"{name} may unpickle"
    if options.get("allow_pickle", "False") != "False":
        yield f"{name} with pickles"


def test_no_module_runs_what_it_reads():
    found = {path: list(doubts(path.read_text(encoding="utf-8"))) for path in SOURCES}
    assert len(found) > 200
    assert {path: said for path, said in found.items() if said} == KNOWN


@pytest.mark.parametrize(
    "source",
    ["import pickle", "from urllib.request import urlopen", "eval('1')", "np.load(f)", "np.load(f, allow_pickle=True)",
     "subprocess.run(c, shell=True)", "os.system('ls')", "import http.client as c", "os.execv('a', b)"],
)  # fmt: skip
def test_the_check_would_find_it(source):
    assert len(list(doubts(source))) >= 1


def test_a_run_never_asks_for_the_network(photos, tmp_path):
    out, script = tmp_path / "out", Path(__file__).with_name("offline.py")
    command = [sys.executable, str(script), "run", str(photos), "-o", str(out), *QUICK, "--until", "scene"]
    process = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert process.returncode == 0, process.stderr
    assert (out / "sparse").is_dir()


def test_the_ear_at_the_network_hears(tmp_path):
    script = Path(__file__).with_name("offline.py")
    ear = f"import runpy; sys.addaudithook(runpy.run_path({str(script)!r})['listen'])"
    code = f"import socket, sys; {ear}; socket.getaddrinfo('localhost', 80)"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert process.returncode == 99 and "socket.getaddrinfo" in process.stderr


NAMES = (
    "';drop table images;--\".jpg", "%s%n{0}{name}.jpg", "a\nb\r.jpg", "\x1b[31m\x1b]0;title\x07.jpg",
    "[red]bold[/].jpg", "<script>alert(1)</script>.jpg", "-o --help.jpg", "\u202e$(touch x)`touch x`gpj.exe.jpg",
)  # fmt: skip


@pytest.fixture
def named(photos, tmp_path):
    """The photos under other names, in a folder with a strange name, too."""
    folder = tmp_path / "[red]%s{}';--\x1b[2J"
    folder.mkdir()
    originals = sorted(photos.iterdir())
    return folder, originals


@pytest.mark.parametrize("at", [0, 4])
def test_names_are_nothing_but_names(named, tmp_path, at):
    folder, originals = named
    names = NAMES[at : at + len(originals)]
    for original, name in zip(originals, names, strict=True):
        path = folder / name.replace("/", "\u2215")
        shutil.copy(original, path)
    paths = sorted(path.name for path in folder.iterdir())
    (folder / "no photo \x1b[2J [red].txt").write_text("a text")
    out = tmp_path / "out \x1b[2J[red]%s{}"
    flags = [flag for flag in QUICK if flag != "-q"]

    told = CliRunner().invoke(main, ["run", str(folder), "-o", str(out), *flags, "--until", "scene"])

    assert told.exit_code == 0, told.output
    assert all(line.isprintable() for text in (told.stdout, told.stderr) for line in text.split("\n"))
    assert "no photo \\x1b[2J [red].txt: not a photo" in told.stdout
    manifest = json.loads((out / "manifest.json").read_text())["stages"]
    with contextlib.closing(sqlite3.connect(out / "database.db")) as database:
        stored = [name for (name,) in database.execute("SELECT name FROM images")]
    assert manifest["photos"]["counts"]["usable"] == len(paths) == len(stored)
    assert manifest["scene"]["counts"]["registered"] == len(paths)
    assert all(name.isprintable() for name in stored)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted((folder.name, out.name))
