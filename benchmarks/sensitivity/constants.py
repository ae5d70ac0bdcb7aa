"""Constants that were chosen by hand: where they stand, and how to import the program with one of them changed."""

import ast
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import decode_source, spec_from_file_location
from itertools import pairwise
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[2]
ROOMS = ("fundamental", "selfcal", "geometry", "posegraph")
"""Whose constants are asked. What mapping and surfaces do takes minutes for each of them."""
BY_HAND = "by hand"
SCALE = "_scale_constant"


@dataclass(frozen=True, slots=True)
class Constant:
    """One assignment of one or more numbers."""

    path: str
    """Of the module, below the project's root."""
    names: str
    """As they are assigned, joined by commas; a field is `OPTIONS.name`."""

    @property
    def module(self) -> str:
        """Dotted name of the module."""
        return self.path.removesuffix(".py").replace("/", ".")


def constants(rooms: Sequence[str] = ROOMS, root: Path = ROOT) -> list[Constant]:
    """Return every constant whose docstring says that it was chosen by hand."""
    return [
        Constant(path.relative_to(root).as_posix(), names)
        for path in sorted(path for room in rooms for path in (root / "sfm_app" / room).rglob("*.py"))
        for names, _, about in assignments(ast.parse(path.read_text(encoding="utf-8")))
        if BY_HAND in about.lower()
    ]


def assignments(tree: ast.Module | ast.ClassDef) -> Iterator[tuple[str, ast.Assign | ast.AnnAssign, str]]:
    """Yield names, statement and docstring of the constants of a module, with the fields of its classes of constants.

    The docstring of a field is followed by that of its class.
    """
    for statement, after in pairwise([*tree.body, None]):
        if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            names = [node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)]
            text = after.value if isinstance(after, ast.Expr) else None
            about = str(text.value) if isinstance(text, ast.Constant) else ""
            yield ", ".join(names), statement, " ".join(about.split())
        elif isinstance(statement, ast.ClassDef) and (statement.name.isupper() or statement.name.endswith("Options")):
            whole = " ".join((ast.get_docstring(statement) or "").split())
            for name, field, about in assignments(statement):
                yield f"{statement.name}.{name}", field, f"{about} {whole}".strip()


def is_compiled(constant: Constant) -> bool:
    """Return whether a kernel may hold the constant, so that cached machine code would hide a change of it."""
    return not kernel_names().isdisjoint(constant.names.split(", "))


@cache
def kernel_names() -> frozenset[str]:
    """Return all names that stand in a kernel."""
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "sfm_app").rglob("*.py"))
    kernels = (
        node
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and any("kernel" in ast.dump(mark) for mark in node.decorator_list)
    )
    return frozenset(node.id for kernel in kernels for node in ast.walk(kernel) if isinstance(node, ast.Name))


def scale(value: Any, factor: float) -> Any:
    """Return a constant times a factor; what is near 1 keeps below it.

    A share between 0.5 and 1 says how little is missing to 1: that distance is scaled. Whole numbers stay whole and
    above 0.

    Args:
        value: number, array, tuple or dictionary of these; anything else stays as it is.
        factor: > 0.
    """
    if isinstance(value, bool | str) or value is None:
        return value
    if isinstance(value, int):
        return max(1, round(value * factor)) if value > 0 else round(value * factor)
    if isinstance(value, float):
        return 1.0 - (1.0 - value) * factor if 0.5 < value < 1.0 else value * factor
    if isinstance(value, np.ndarray):
        return value * factor
    if isinstance(value, tuple):
        parts = [scale(part, factor) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if isinstance(value, dict):
        return {key: scale(part, factor) for key, part in value.items()}
    return value


class ScaledLoader(SourceFileLoader):
    """Loads one module with one of its constants scaled."""

    def __init__(self, fullname: str, path: str, names: str, factor: float) -> None:
        super().__init__(fullname, path)
        self.names, self.factor = names, factor

    def get_code(self, fullname: str) -> CodeType:  # noqa: ARG002 -- the loader's own name
        """Compile the module, the constant's value wrapped in a call of `scale`."""
        tree = ast.parse(decode_source(self.get_data(self.path)))
        for names, statement, _ in assignments(tree):
            if names == self.names and statement.value is not None:
                call = ast.Call(ast.Name(SCALE, ast.Load()), [statement.value, ast.Constant(self.factor)], [])
                statement.value = ast.copy_location(call, statement.value)
        return compile(ast.fix_missing_locations(tree), self.path, "exec")

    def exec_module(self, module: ModuleType) -> None:
        """Run the module with `scale` in reach."""
        vars(module)[SCALE] = scale
        super().exec_module(module)


class ScaledFinder(MetaPathFinder):
    """Finds the module of a constant before anybody else does."""

    def __init__(self, constant: Constant, factor: float, root: Path) -> None:
        self.constant, self.factor, self.root = constant, factor, root

    def find_spec(self, fullname: str, *_: object) -> ModuleSpec | None:
        """Return how to load the module of this dotted name; None for all others."""
        if fullname != self.constant.module:
            return None
        file = str(self.root / self.constant.path)
        loader: Loader = ScaledLoader(fullname, file, self.constant.names, self.factor)
        return spec_from_file_location(fullname, file, loader=loader)


def install(constant: Constant, factor: float, root: Path = ROOT) -> None:
    """Scale a constant in whatever is imported from now on.

    Raises:
        RuntimeError: its module has been imported already.
    """
    if constant.module in sys.modules:
        raise RuntimeError(f"{constant.module} is imported already")
    sys.meta_path.insert(0, ScaledFinder(constant, factor, root))
