"""What differs between operating systems is in `sfm_app.operating_system`, and text files are the same on all."""

import ast
from pathlib import Path

import pytest

import sfm_app

PACKAGE = Path(sfm_app.__file__).parent
HOUSE = "operating_system"
MODULES = {
    *("fcntl", "grp", "msvcrt", "nt", "posix", "pty", "pwd", "resource", "signal", "termios", "tty", "winreg"),
    *("ctypes", "multiprocessing"),
}
ALLOWED = {
    ("photos/decode.py", "ctypes"),  # the type of a callback
    ("colmap/database.py", "ctypes"),  # Python's own counter of references
    ("synthetic/photo_folder.py", "multiprocessing"),  # the context is named: see below
    ("cli/output.py", "platform"),  # whether somebody sits at a screen
    ("runtime/workspace.py", "platform"),  # names the machine
    ("cli/doctor.py", "platform"),  # says what this system is called
    ("runtime/cluster.py", "platform"),
}
NAMES = {
    *("killpg", "kill_tree", "setsid", "setpgid", "getpgid", "getppid", "fork", "forkpty", "sched_getaffinity", "nice"),
    *("cpu_count", "process_cpu_count", "sysconf", "statvfs", "uname", "umask", "mkfifo"),
    *("link", "symlink", "symlink_to", "hardlink_to", "readlink", "is_symlink", "is_junction", "rename", "renames"),
    *("chmod", "lchmod", "chown", "getuid", "geteuid", "getgid", "virtual_memory", "RTLD_GLOBAL", "CDLL"),
    *("set_start_method", "platform", "sigwait"),
}
"""Attributes of `os`, `pathlib.Path`, `sys`, `psutil` and `ctypes` that some system lacks, or understands otherwise."""
OPTIONS = {"start_new_session", "preexec_fn", "process_group", "creationflags", "pass_fds", "universal_newlines"}
"""Of `subprocess`."""
PLACES = ("/proc", "/sys/", "/dev/", "/etc/", "/var/", "/usr/")


def modules():
    paths = sorted(path for path in PACKAGE.rglob("*.py") if path.relative_to(PACKAGE).parts[0] != HOUSE)
    return {path.relative_to(PACKAGE).as_posix(): path for path in paths}


def offences(text):
    """What a module has that belongs into the house, as pairs of a word and a line."""
    tree = ast.parse(text)
    said = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}  # docstrings may say anything
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((name, node.lineno) for one in node.names if (name := one.name.partition(".")[0]) in MODULES)
        elif isinstance(node, ast.ImportFrom):
            if (name := (node.module or "").partition(".")[0]) in MODULES:
                yield name, node.lineno
            yield from ((one.name, node.lineno) for one in node.names if node.module == "os" and one.name in NAMES)
        elif isinstance(node, ast.Attribute):
            if node.attr in NAMES or node.attr.startswith(("SIG", "O_")) or is_of_os(node):
                yield node.attr, node.lineno
        elif isinstance(node, ast.Call):
            yield from ((one.arg, node.lineno) for one in node.keywords if one.arg in OPTIONS)
            if isinstance(node.func, ast.Attribute) and node.func.attr == "replace" and is_path_call(node):
                yield "replace", node.lineno
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in said:
            yield from ((place, node.lineno) for place in PLACES if node.value.startswith(place))


def is_of_os(node):
    """Whether this is `os.name` or `os.times`; others have such names, too."""
    return node.attr in ("name", "times") and isinstance(node.value, ast.Name) and node.value.id == "os"


def is_path_call(node):
    """Whether a call of `replace` moves a file: that of texts has two arguments."""
    of_os = isinstance(node.func.value, ast.Name) and node.func.value.id == "os"
    return of_os or (len(node.args) == 1 and not node.keywords)


def test_no_other_module_asks_which_system_this_is():
    found = [
        (name, word, line)
        for name, path in modules().items()
        for word, line in offences(path.read_text(encoding="utf-8"))
        if (name, word) not in ALLOWED
    ]
    assert found == []


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("import fcntl", "fcntl"),
        ("from signal import SIGTERM", "signal"),
        ("import os\nos.killpg(1, 9)", "killpg"),
        ("from os import link", "link"),
        ("os.name == 'nt'", "name"),
        ("sys.platform", "platform"),
        ("path.symlink_to(other)", "symlink_to"),
        ("path.replace(other)", "replace"),
        ("os.replace(path, other)", "replace"),
        ("Popen(command, start_new_session=True)", "start_new_session"),
        ("Path('/proc/meminfo')", "/proc"),
        ("os.open(path, os.O_DIRECTORY)", "O_DIRECTORY"),
        ("text.replace('a', 'b')", None),
        ("replace(photo, name=name)", None),
        ("'''The text of /proc.'''", None),
        ("photo.name", None),
        ("os.path.relpath(a, b)", None),
    ],
)
def test_the_rule_finds_what_it_is_for(text, word):
    assert [found for found, _ in offences(text)] == ([word] if word else [])


def text_calls(text):
    """Calls that open, read or write a text, with the names of their keyword arguments."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            words = {one.arg for one in node.keywords}
            whole = called in ("read_text", "write_text", "TextIOWrapper")
            if whole or (called == "open" and is_text(node)) or (called in ("Popen", "run") and "text" in words):
                yield called, node.lineno, words


def is_text(node):
    """Whether `open(path, mode)` or `path.open(mode)` opens a file as text; other things are opened, too."""
    modes = [
        one.value for one in (*node.args, *(word.value for word in node.keywords)) if isinstance(one, ast.Constant)
    ]
    plain = isinstance(node.func, ast.Name)
    return any(isinstance(mode, str) and set(mode) <= set("rwax+t") and mode for mode in modes) or (plain and not modes)


def test_texts_have_one_encoding_and_one_end_of_lines():
    found = [
        (name, called)
        for name, path in modules().items()
        for called, _, words in text_calls(path.read_text(encoding="utf-8"))
        if "encoding" not in words or (called == "write_text" and "newline" not in words)
    ]
    assert found == [("colmap/perspective.py", "write_text")]  # COLMAP's own


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("open(path)", 1),
        ("path.open('w')", 1),
        ("run(command, text=True)", 1),
        ("path.read_text()", 1),
        ("path.open('rb')", 0),
        ("Image.open(path)", 0),
        ("run(command)", 0),
    ],
)
def test_the_rule_finds_texts(text, count):
    assert len(list(text_calls(text))) == count


def test_processes_are_spawned():
    text = (PACKAGE / "synthetic" / "photo_folder.py").read_text(encoding="utf-8")
    contexts = [
        ast.literal_eval(node.args[0])
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "get_context"
    ]
    assert contexts == ["spawn"]
