"""Every command on a page can be typed; those of the tutorial and the how-to pages are run."""

import importlib.util
import re
import tomllib

import click
import pytest
from click.testing import CliRunner

from sfm_app.cli import options
from sfm_app.cli.program import main
from sfm_app.colmap import backend
from tests.docs.pages import PAGES, ROOT, SHELL, blocks, commands

PROGRAM = "sfm-app"
RUNNERS = {"uvx", "uv", "pipx", "docker", "podman"}
"""What follows the program's name in their lines is a command of ours."""
OTHERS = {
    ".", "InterfaceCOLMAP", "cd", "colmap", "cp", "curl", "dask", "echo", "eval", "export", "git", "jupyter",
    "ls", "mkdir", "npm", "ns-train", "pre-commit", "source", "twine",
}  # fmt: skip
"""Programs of other people."""
TRAINERS = {"train.py", "examples/simple_trainer.py"}
"""Scripts in other people's folders."""
ALL = [
    (block, words)
    for page in PAGES
    for block in blocks(page)
    if block.language in SHELL or (not block.language and re.search(r"^(sfm-app|\.venv/bin/|make |pip )", block.text))
    for words in commands(block)
]


def name_of(program):
    return program.removeprefix(".venv/bin/")


@pytest.fixture(autouse=True)
def quiet_colmap(monkeypatch):
    """COLMAP's log stays as it is, wherever the options find the function that changes it."""
    monkeypatch.setattr(backend, "show_log", lambda _: None)
    monkeypatch.setattr(options, "show_log", lambda _: None, raising=False)


@pytest.mark.parametrize(("block", "words"), ALL, ids=[f"{block}-{' '.join(words)[:60]}" for block, words in ALL])
def test_a_command_can_be_typed(block, words):
    program, *rest = words
    if (name := name_of(program)) == PROGRAM:
        check_ours(rest)
    elif name in RUNNERS:
        named = [k for k, word in enumerate(rest) if word == PROGRAM]
        for k in named[-1:]:
            check_ours(rest[k + 1 :])
    elif name == "make":
        assert set(rest[:1]) <= targets()
    elif name == "pip":
        check_pip(rest, block.page.parent)
    elif name in ("python", "python3"):
        check_python(rest, block.page.parent)
    else:
        assert name in OTHERS


def check_ours(words):
    """Parse a command of ours as it would be, and its settings; nothing is run."""
    command, context = main, click.Context(main, info_name=PROGRAM)
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        found = command.get_command(context, words[0])
        assert found is not None, f"no command {words[0]}"
        command, words = found, words[1:]
    if {"--help", "--version", "-h"} & set(words) or isinstance(command, click.Group):
        return
    parsed = command.make_context(command.name, list(words))
    if "assignments" in parsed.params and not parsed.params["config"]:
        options.settings_from_flags(parsed.params)


def targets():
    """Return what `make` can make."""
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))


def check_pip(words, folder):
    """Extras exist, and so do folders."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    for word in words[1:]:
        if found := re.fullmatch(r"(?:sfm-app|\.)\[([a-z,]+)\]", word):
            assert set(found[1].split(",")) <= set(extras)
        elif word.startswith("."):
            assert (ROOT / word).exists() or (folder / word).exists()


def check_python(words, folder):
    """Modules can be found, and scripts are there."""
    if words[0] == "-m":
        assert importlib.util.find_spec(words[1]) is not None
    elif words[0].endswith(".py") and words[0] not in TRAINERS:
        assert (ROOT / words[0]).exists() or (folder / words[0]).exists()


def test_there_are_many():
    assert sum(name_of(words[0]) == PROGRAM for _, words in ALL) > 50


COMMANDS = (
    ("run photos -o out", "model.glb"), ("run photos -o out --until scene --json", '"photos"'),
    ("calibrate photos -o out --figure camera.png", "px"), ("export out --format obj", "model.obj"),
    ("export out --format colmap", "colmap"), ("export out --format splat", "splat"),
    ("export out --points -o scene.ply", "scene.ply"), ("measure out 0,0,0 1,0,0", "+-"),
    ("report out", "report.html"), ("markers 50mm -o markers.pdf", "markers.pdf"),
    ("config --set depth.neighbors=6", "neighbors = 6"), ("plugins", "lev-ransac"),
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("typed", "says"), COMMANDS, ids=[typed for typed, _ in COMMANDS])
def test_it_does_what_the_page_says(typed, says, beside_a_run):
    done = CliRunner().invoke(main, typed.split())
    assert done.exit_code == 0, done.output
    assert says in done.output
