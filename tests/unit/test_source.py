"""The source: only `operating_system` asks for the system, texts have one encoding, constants name their source."""

import ast
import re
from pathlib import Path

import pytest

import sfm_app
from benchmarks import size
from benchmarks.sensitivity.constants import ROOMS, assignments

PACKAGE, ROOT = Path(sfm_app.__file__).parent, Path(__file__).parents[2]
MODULES = {
    *("fcntl", "grp", "msvcrt", "nt", "posix", "pty", "pwd", "resource", "signal", "termios", "tty", "winreg"),
    *("ctypes", "multiprocessing"),
}
ALLOWED = {
    ("photos/decode.py", "ctypes"),  # the type of a callback
    ("colmap/database.py", "ctypes"),  # Python's own counter of references
    ("synthetic/photo_folder.py", "multiprocessing"),  # its context is tested below
    ("cli/output.py", "platform"),  # whether a terminal shows the output
    ("runtime/workspace.py", "platform"),  # the name of the machine
    ("cli/doctor.py", "platform"),  # the name of the system
    ("runtime/cluster.py", "platform"),
}
NAMES = {
    *("killpg", "kill_tree", "setsid", "setpgid", "getpgid", "getppid", "fork", "forkpty", "sched_getaffinity", "nice"),
    *("cpu_count", "process_cpu_count", "sysconf", "statvfs", "uname", "umask", "mkfifo"),
    *("link", "symlink", "symlink_to", "hardlink_to", "readlink", "is_symlink", "is_junction", "rename", "renames"),
    *("chmod", "lchmod", "chown", "getuid", "geteuid", "getgid", "virtual_memory", "RTLD_GLOBAL", "CDLL"),
    *("set_start_method", "platform", "sigwait"),
}
"""Attributes of `os`, `pathlib.Path`, `sys`, `psutil` and `ctypes` that differ between systems."""
OPTIONS = {"start_new_session", "preexec_fn", "process_group", "creationflags", "pass_fds", "universal_newlines"}
"""Options of `subprocess` that differ between systems."""
PLACES = ("/proc", "/sys/", "/dev/", "/etc/", "/var/", "/usr/")
YEAR = r"\b(?:18|19|20)\d\d\b"
SOURCE = re.compile(
    rf"[Tt]hesis|\bEq\. |{YEAR}|docs/algorithms\.md|benchmarks[/.]|"
    r"\b[Bb]y hand|\b[Cc]hosen on\b|\bCOLMAP\b|\b[Bb]y definition\b|\bCounted\b|double precision"
)
"""The thesis, a paper, COLMAP, the data of a measurement, a definition, rounding, or that it is a guess."""


def texts(*rooms):
    """The text of every module of these packages, or of all, by path below the package."""
    paths = (path for room in rooms or [""] for path in size.python_files(PACKAGE / room))
    return {path.relative_to(PACKAGE).as_posix(): path.read_text(encoding="utf-8") for path in paths}


def offences(text):
    """Names and lines of a module that belong into `operating_system`."""
    tree = ast.parse(text)
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((name, node.lineno) for one in node.names if (name := one.name.partition(".")[0]) in MODULES)
        elif isinstance(node, ast.ImportFrom):
            if (name := (node.module or "").partition(".")[0]) in MODULES:
                yield name, node.lineno
            yield from ((one.name, node.lineno) for one in node.names if node.module == "os" and one.name in NAMES)
        elif isinstance(node, ast.Attribute):
            if node.attr in NAMES or node.attr.startswith(("SIG", "O_")) or is_of_os(node, "name", "times"):
                yield node.attr, node.lineno
        elif isinstance(node, ast.Call):
            yield from ((one.arg, node.lineno) for one in node.keywords if one.arg in OPTIONS)
            if isinstance(node.func, ast.Attribute) and node.func.attr == "replace" and is_path_call(node):
                yield "replace", node.lineno
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield from ((place, node.lineno) for place in PLACES if node.value.startswith(place))


def is_of_os(node, *names):
    return node.attr in names and isinstance(node.value, ast.Name) and node.value.id == "os"


def is_path_call(node):
    """Whether a call of `replace` moves a file: that of texts has two arguments."""
    return is_of_os(node.func, "replace") or (len(node.args) == 1 and not node.keywords)


def test_no_other_module_asks_which_system_this_is():
    found = [
        (name, word, line)
        for name, text in texts().items()
        for word, line in offences(text)
        if name != "operating_system.py" and (name, word) not in ALLOWED
    ]
    assert found == []


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("import fcntl", "fcntl"), ("from signal import SIGTERM", "signal"), ("import os\nos.killpg(1, 9)", "killpg"),
        ("from os import link", "link"), ("os.name == 'nt'", "name"), ("path.replace(other)", "replace"),
        ("os.replace(path, other)", "replace"), ("Popen(command, start_new_session=True)", "start_new_session"),
        ("Path('/proc/meminfo')", "/proc"), ("os.open(path, os.O_DIRECTORY)", "O_DIRECTORY"),
        ("text.replace('a', 'b')", None), ("replace(photo, name=name)", None), ("'''The text of /proc.'''", None),
        ("photo.name", None),
    ],
)  # fmt: skip
def test_names_that_differ_between_systems_are_found(text, word):
    assert [found for found, _ in offences(text)] == ([word] if word else [])


def text_calls(text):
    """Calls that open, read or write a text, with the names of their keyword arguments."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            words = {one.arg for one in node.keywords}
            whole = called in ("read_text", "write_text", "TextIOWrapper")
            if whole or (called == "open" and is_text(node)) or (called in ("Popen", "run") and "text" in words):
                yield called, words


def is_text(node):
    """Whether `open(path, mode)` or `path.open(mode)` opens a file as text."""
    modes = [one.value for one in (*node.args, *(word.value for word in node.keywords)) if hasattr(one, "value")]
    plain = isinstance(node.func, ast.Name)
    return any(isinstance(mode, str) and set(mode) <= set("rwax+t") and mode for mode in modes) or (plain and not modes)


def test_texts_have_one_encoding_and_one_end_of_lines():
    found = [
        (name, called)
        for name, text in texts().items()
        for called, words in text_calls(text)
        if "encoding" not in words or (called == "write_text" and "newline" not in words)
    ]
    assert found == [("colmap/perspective.py", "write_text")]  # COLMAP's own


def test_processes_are_spawned():
    nodes = ast.walk(ast.parse((PACKAGE / "synthetic" / "photo_folder.py").read_text(encoding="utf-8")))
    calls = [node for node in nodes if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "get_context"]
    assert [ast.literal_eval(call.args[0]) for call in calls] == ["spawn"]


def constants(text):
    """Docstrings of the constants that hold numbers, by name; fields of options are constants, too."""
    return {
        names: about
        for names, statement, about in assignments(ast.parse(text))
        if re.search(r"\b_?[A-Z][A-Z0-9_]*\b|\.", names) and holds_numbers(statement.value)
    }


def holds_numbers(value):
    if isinstance(value, ast.Call) and isinstance(value.func, ast.Name) and value.func.id == "range":
        return False
    return any(isinstance(node, ast.Constant) and type(node.value) in (int, float) for node in ast.walk(value))


def silent(text):
    """Names of the constants whose docstring names no source, or that have none."""
    return [name for name, about in constants(text).items() if not SOURCE.search(about)]


def test_every_constant_says_where_it_comes_from():
    modules = texts(*ROOMS)
    assert sum(len(constants(text)) for text in modules.values()) > 100
    assert [(module, name) for module, text in modules.items() for name in silent(text)] == []


def test_pages_and_commands_that_constants_refer_to_exist():
    page = (ROOT / "docs" / "algorithms.md").read_text(encoding="utf-8")
    for name, about in (
        (f"{module}: {name}", about) for module, text in texts().items() for name, about in constants(text).items()
    ):
        for section, number in re.findall(r"docs/algorithms\.md, ([A-Z][A-Za-z' -]+)(?:, (\d))?", about):
            assert section in page, f"{name}: {section}"
            assert not number or f"**{number}. " in page, f"{name}: {section}, {number}"
        for file in re.findall(r"\b(?:benchmarks|docs)/[\w/-]+\.(?:py|md)\b", about):
            assert (ROOT / file).is_file(), f"{name}: {file}"
        for command in re.findall(r"\bpython -m (benchmarks(?:\.\w+)+)", about):
            place = ROOT / command.replace(".", "/")
            assert (place / "__main__.py").is_file() or place.with_suffix(".py").is_file(), f"{name}: {command}"
