"""docs/symbols.md and docs/thesis-map.md name nothing that the code has not, and leave out no equation."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import sfm_app

PACKAGE = Path(sfm_app.__file__).parent
DOCS = Path(__file__).parents[2] / "docs"
TEXT = (DOCS / "symbols.md").read_text(encoding="utf-8")
MAP = (DOCS / "thesis-map.md").read_text(encoding="utf-8")
COMMAND = "python -m "
NAMES = sorted({name for name in re.findall(r"`([^`]+)`", TEXT + MAP) if not name.startswith(COMMAND)} - {"sfm_app"})
LAST_EQUATIONS = {2: 38, 3: 22, 4: 18, 5: 35}
"""The last numbered equation of each chapter of the thesis."""
SHAPE = re.compile(r"([a-z_0-9.]+(?:\.[A-Za-z_0-9]+)*)(?:\((\w+)\))?")


@cache
def tree(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def named_in(node, deep):
    """What a class or module defines, or with `deep` every name within a function."""
    if deep:
        arguments = {part.arg for part in ast.walk(node) if isinstance(part, ast.arg)}
        return arguments | {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
    found = set()
    for part in node.body:
        if isinstance(part, ast.FunctionDef | ast.ClassDef):
            found.add(part.name)
        elif isinstance(part, ast.AnnAssign | ast.Assign):
            targets = part.targets if isinstance(part, ast.Assign) else [part.target]
            found |= {name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)}
    return found


def exists(name):
    """Whether `package.module.Class.member` or `package.module.function(variable)` is in the code."""
    shape = SHAPE.fullmatch(name)
    if not shape:
        return is_method(name)
    *path, within = *shape.group(1).split("."), shape.group(2)
    folder = PACKAGE
    while path and (folder / path[0]).is_dir():
        folder /= path.pop(0)
    if not path:
        return within is None and folder != PACKAGE
    file = folder / f"{path.pop(0)}.py"
    if not file.is_file():
        return len(shape.group(1).split(".")) == 1 and is_method(name)
    node = tree(file)
    for part in path:
        if not isinstance(node, ast.Module | ast.ClassDef) or part not in named_in(node, deep=False):
            return False
        node = next((child for child in node.body if getattr(child, "name", None) == part), None)
    return within is None or (isinstance(node, ast.FunctionDef) and within in named_in(node, deep=True))


@cache
def words():
    """Every string in the packages of the methods."""
    trees = (tree(path) for room in ("fundamental", "selfcal") for path in (PACKAGE / room).rglob("*.py"))
    nodes = (node for found in trees for node in ast.walk(found))
    return {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def is_method(name):
    """Whether an estimator or a calibrator has that name."""
    return name in words()


@pytest.mark.parametrize("name", NAMES)
def test_every_name_on_the_page_is_in_the_code(name):
    assert exists(name)


@pytest.mark.parametrize(
    "name",
    [
        "fundamental.loop.serch", "fundamental.lop.search", "fundamental.loop.search(nobody)",
        "fundamental.points.Matches.nothing",
        "lev-ransac-thesi", "nothing", "fundamental.loop.Best.f.x",
    ],
)  # fmt: skip
def test_what_is_not_in_the_code_is_found(name):
    assert not exists(name)


def test_every_equation_of_both_chapters_is_on_the_page():
    ranges = re.findall(r"\b([45])\.(\d+) to [45]\.(\d+)", TEXT)
    listed = {(chapter, k) for chapter, first, last in ranges for k in range(int(first), int(last) + 1)}
    for cell in re.findall(r"Eq\. [^|]*", TEXT):
        listed |= {(chapter, int(number)) for chapter, number in re.findall(r"\b([45])\.(\d+)\b", cell)}
    wanted = {("4", k) for k in range(1, 19)} | {("5", k) for k in range(1, 36)}
    assert wanted - listed == set()


def test_every_equation_of_four_chapters_is_on_the_map():
    cells = re.findall(r"^\| ([2-5]\.[^|]*) \|", MAP, re.MULTILINE)
    listed = []
    for cell in cells:
        for first, last in re.findall(r"\d\.(\d+)(?: to \d\.(\d+))?", cell):
            listed += [(int(cell[0]), number) for number in range(int(first), int(last or first) + 1)]
    assert sorted(listed) == [(chapter, k) for chapter, last in LAST_EQUATIONS.items() for k in range(1, last + 1)]


def test_every_algorithm_is_on_the_map():
    assert re.findall(r"^\| Algorithm (\d) \|", MAP, re.MULTILINE) == ["1", "2", "3", "4"]


def test_every_function_on_the_map_is_a_path():
    """A bare word would pass for the name of a method."""
    names = {name for name in re.findall(r"`([^`]+)`", MAP) if not name.startswith(COMMAND)}
    methods = {name for name in names if "." not in name}
    assert methods == {
        "sfm_app", "lev-ransac", "lev-ransac-thesis", "multi-start", "perturbation", "zero-curves",
        "zero-curves-thesis",
    }  # fmt: skip
