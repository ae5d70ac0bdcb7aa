"""Constants say where their numbers come from, and modules of the two methods which equation or paper they are."""

import ast
import re
from pathlib import Path

import pytest

import sfm_app
from benchmarks.sensitivity.constants import assignments

PACKAGE, ROOT = Path(sfm_app.__file__).parent, Path(__file__).parents[2]
METHODS = ("ransac", "selfcal")
ROOMS = (*METHODS, "geometry", "posegraph")
"""Whose constants are asked; who writes down the sources of another package enters it here."""
NAME = re.compile(r"_?[A-Z][A-Z0-9_]*")
YEAR = r"\b(?:18|19|20)\d\d\b"
POINTER = re.compile(rf"[Tt]hesis|\bEq\. |{YEAR}|\b[Oo]urs\b")
"""The thesis, an equation of it, a paper, or nobody else."""
SOURCE = re.compile(
    rf"[Tt]hesis|\bEq\. |{YEAR}|docs/algorithms\.md|benchmarks[/.]|"
    r"by hand|\b[Bb]y definition\b|\bCounted\b|double precision"
)
"""The thesis, a paper, a page or command with the measurement, a definition, rounding, or that it is a guess."""


def modules(rooms):
    return sorted(path for room in rooms for path in (PACKAGE / room).rglob("*.py"))


def named(path):
    """A module as the tests call it."""
    return path.relative_to(PACKAGE).as_posix()


def constants(text):
    """Every module-level constant that holds numbers, with its docstring; numbered places are no quantities."""
    return {
        names: about
        for names, statement, about in assignments(ast.parse(text))
        if any(NAME.fullmatch(name) for name in names.split(", ")) and holds_numbers(statement.value)
    }


def holds_numbers(value):
    if isinstance(value, ast.Call) and isinstance(value.func, ast.Name) and value.func.id == "range":
        return False
    return any(isinstance(node, ast.Constant) and type(node.value) in (int, float) for node in ast.walk(value))


def silent(text):
    """Names of the constants whose docstring names no source, or that have none."""
    return [name for name, about in constants(text).items() if not SOURCE.search(about)]


@pytest.fixture(scope="module")
def texts():
    """What stands in every module of the rooms, by its name."""
    return {named(path): path.read_text(encoding="utf-8") for path in modules(ROOMS)}


def test_every_constant_says_where_it_comes_from(texts):
    assert sum(len(constants(text)) for text in texts.values()) > 100
    assert [(module, name) for module, text in texts.items() for name in silent(text)] == []


def test_what_a_constant_refers_to_is_there(texts):
    page = (ROOT / "docs" / "algorithms.md").read_text(encoding="utf-8")
    for name, about in (
        (f"{module}: {name}", about) for module, text in texts.items() for name, about in constants(text).items()
    ):
        for section, number in re.findall(r"docs/algorithms\.md, ([A-Z][A-Za-z' -]+)(?:, (\d))?", about):
            assert section in page, f"{name}: {section}"
            assert not number or f"**{number}. " in page, f"{name}: {section}, {number}"
        for file in re.findall(r"\b(?:benchmarks|docs)/[\w/-]+\.(?:py|md)\b", about):
            assert (ROOT / file).is_file(), f"{name}: {file}"
        for command in re.findall(r"\bpython -m (benchmarks(?:\.\w+)+)", about):
            place = ROOT / command.replace(".", "/")
            assert (place / "__main__.py").is_file() or place.with_suffix(".py").is_file(), f"{name}: {command}"


def test_every_module_says_which_equation_or_paper_it_is(texts):
    """A section of the thesis, a paper, or that it is ours."""
    abouts = {
        name: ast.get_docstring(ast.parse(text)) or "" for name, text in texts.items() if name.startswith(METHODS)
    }
    assert len(abouts) > 50
    assert [name for name, about in abouts.items() if not POINTER.search(about)] == []


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("BARE = 3.0", ["BARE"]),
        ("A, _B = 1, 2.5", ["A, _B"]),
        ('MUTE = 3.0\n"""Thresholds."""', ["MUTE"]),
        ("TABLE = {7: 160.0}", ["TABLE"]),
        ("SCALED: float = 2 * np.log(50)", ["SCALED"]),
        ('PAPER = 2.5\n"""Of LMedS (Rousseeuw and Leroy 1987)."""', []),
        ('GUESS = 2.5\n"""Chosen by hand; not measured on its own."""', []),
        ("X, Y = range(2)\nWORD = 'seven'\nlower = 3", []),
    ],
)
def test_constants_without_a_source_are_found(text, names):
    assert silent(text) == names


def test_a_number_that_all_packages_share_stands_in_one_place():
    holders = [
        named(path)
        for path in PACKAGE.rglob("*.py")
        if any(
            isinstance(node, ast.Constant) and node.value == 1.4826
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        )
    ]
    assert holders == ["numerical.py"]
