"""Signatures say what they take and give: `Any` is an exception in the packages that handle COLMAP's objects."""

import ast
from pathlib import Path

import pytest

import sfm_app

PACKAGE = Path(sfm_app.__file__).parent
ROOMS = ("colmap", "reconstruction", "stages")
MOST = 4
"""Signatures with `Any` in all of them together."""


def annotations(function):
    """The annotations of a function's parameters and of what it returns."""
    given = function.args
    parameters = (*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg)
    return [parameter.annotation for parameter in parameters if parameter is not None] + [function.returns]


def names(annotation):
    """All names in an annotation, those in a quoted one too."""
    for node in ast.walk(annotation):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from names(ast.parse(node.value, mode="eval"))
        elif isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr


def vague(text):
    """The functions of a module with `Any` in their signatures."""
    functions = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))
    return [
        function.name
        for function in functions
        if any("Any" in names(annotation) for annotation in annotations(function) if annotation is not None)
    ]


def test_few_signatures_say_any():
    paths = [path for room in ROOMS for path in sorted((PACKAGE / room).rglob("*.py"))]
    found = [f"{path.relative_to(PACKAGE)}: {name}" for path in paths for name in vague(path.read_text("utf-8"))]

    assert len(paths) > 30
    assert len(found) <= MOST, found


@pytest.mark.parametrize(
    "signature",
    [
        "def f(a: Any): ...",
        "def f(*, a: list[Any]): ...",
        "def f(**a: typing.Any): ...",
        "def f() -> 'dict[str, Any]': ...",
        "class C:\n    async def f(self, *a: Any): ...",
    ],
)
def test_any_is_found_wherever_it_stands(signature):
    assert vague(signature) == ["f"]


def test_what_only_sounds_like_it_is_not_found():
    assert vague("def f(a: AnyStr, b: 'Anything') -> int:\n    c: Any = a\n    return c") == []
