"""Constants say where they come from, and what they refer to exists."""

import ast
import re
from pathlib import Path

import pytest

import sfm_app
from benchmarks import size
from benchmarks.sensitivity.constants import ROOMS, assignments

PACKAGE, ROOT = Path(sfm_app.__file__).parent, Path(__file__).parents[2]

YEAR = r"\b(?:18|19|20)\d\d\b"
SOURCE = re.compile(
    rf"[Tt]hesis|\bEq\. |{YEAR}|docs/algorithms/|benchmarks[/.]|"
    r"\b[Bb]y hand|\b[Cc]hosen on\b|\bCOLMAP\b|\b[Bb]y definition\b|\bCounted\b|double precision"
)
"""The thesis, a paper, COLMAP, the data of a measurement, a definition, rounding, or that it is a guess."""


def texts(*rooms):
    """The text of every module of these packages, or of all, by path below the package."""
    paths = (path for room in rooms or [""] for path in size.python_files(PACKAGE / room))
    return {path.relative_to(PACKAGE).as_posix(): path.read_text(encoding="utf-8") for path in paths}


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


@pytest.mark.slow
def test_every_constant_says_where_it_comes_from():
    modules = texts(*ROOMS)
    assert sum(len(constants(text)) for text in modules.values()) > 100
    assert [(module, name) for module, text in modules.items() for name in silent(text)] == []


@pytest.mark.slow
def test_pages_and_commands_that_constants_refer_to_exist():
    for name, about in (
        (f"{module}: {name}", about) for module, text in texts().items() for name, about in constants(text).items()
    ):
        for file in re.findall(r"\b(?:benchmarks|docs)/[\w/-]+\.(?:py|md)\b", about):
            assert (ROOT / file).is_file(), f"{name}: {file}"
        for page, step in re.findall(r"\b(docs/algorithms/[\w-]+\.md), (\d)", about):
            assert f"**{step}. " in (ROOT / page).read_text(encoding="utf-8"), f"{name}: {page}, {step}"
        for command in re.findall(r"\bpython -m (benchmarks(?:\.\w+)+)", about):
            place = ROOT / command.replace(".", "/")
            assert (place / "__main__.py").is_file() or place.with_suffix(".py").is_file(), f"{name}: {command}"
