"""How large modules, functions and folders may grow, and what a public function says."""

import ast
from functools import cache
from pathlib import Path

import sfm_app

PACKAGE = Path(sfm_app.__file__).parent


@cache
def modules():
    return {path.relative_to(PACKAGE).as_posix(): path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}


@cache
def trees():
    return {name: ast.parse(text) for name, text in modules().items()}


def functions():
    for name, tree in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield f"{name}:{node.name}", node


def public(body, place):
    """Functions and classes without an underscore, those in classes, too, by name."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield f"{place}:{node.name}", node
            if isinstance(node, ast.ClassDef):
                yield from public(node.body, place)


def test_functions_are_short():
    lines = sorted(node.end_lineno - node.lineno + 1 for _, node in functions())
    assert lines[int(0.9 * len(lines))] <= 23
    assert lines[-1] <= 60


def test_modules_are_short():
    assert {name: count for name, text in modules().items() if (count := text.count("\n")) > 365} == {}
    assert modules()["pipeline.py"].count("\n") <= 150


def test_folders_are_small():
    folders = {path.parent for path in PACKAGE.rglob("*.py")}
    counts = {folder.relative_to(PACKAGE).as_posix(): len(list(folder.glob("*.py"))) for folder in folders}
    assert {folder: count for folder, count in counts.items() if count > 15} == {}


def test_what_is_public_says_what_it_is():
    found = [item for name, tree in trees().items() for item in public(tree.body, name)]
    assert [name for name, node in found if not ast.get_docstring(node)] == []


def test_public_functions_say_what_their_parameters_are():
    silent = []
    for name, tree in trees().items():
        if name.startswith("cli/"):  # click says what the parameters of commands are
            continue
        for place, node in public(tree.body, name):
            if isinstance(node, ast.FunctionDef):
                given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                count = sum(one.arg not in ("self", "cls") for one in given)
                if count >= 2 and "Args:" not in (ast.get_docstring(node) or ""):
                    silent.append(place)
    assert silent == []
