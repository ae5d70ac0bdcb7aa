"""How large the code is: lines, files, import chains, constants, complexity and words; `make lint` prints it.

Nothing is limited here. A figure that grows without a reason is a reason to merge, delete or shorten.
"""

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from statistics import mean, median

ROOT = Path(__file__).parents[1]
PACKAGE = "sfm_app"
SMALL = 60
"""Lines below which a module is hardly a subject."""
BRANCHES = (ast.If, ast.IfExp, ast.For, ast.While, ast.ExceptHandler, ast.comprehension, ast.match_case)


def main() -> None:
    """Print the figures, a line each."""
    for name, value in measure().items():
        print(f"{name:<42}{value}")


def measure() -> dict[str, str]:
    """Return what is counted, by name."""
    files = {module_name(path): path for path in python_files(ROOT / PACKAGE)}
    texts = {name: path.read_text(encoding="utf-8") for name, path in files.items()}
    trees = {name: ast.parse(text) for name, text in texts.items()}
    lines = sorted(text.count("\n") for text in texts.values())
    functions = [node for tree in trees.values() for node in functions_in(tree)]
    branches = [complexity(node) for node in functions]
    parameters = [len(parameters_of(node)) for node in functions]
    return {
        "package, lines": f"{sum(lines)}",
        "package, files": f"{len(files)}, median {median(lines):.0f} lines, longest {lines[-1]}",
        f"modules below {SMALL} lines": f"{sum(1 for name, path in files.items() if is_small(path, texts[name]))}",
        "folders with code": f"{len({path.parent for path in files.values()})}",
        "longest import chain": f"{longest_chain(trees)}, at module level {longest_chain(trees, lazy=False)}",
        "numeric constants of modules": f"{sum(count_numbers(tree) for tree in trees.values())}",
        "complexity, mean and largest": f"{mean(branches):.1f}, {max(branches)}",
        "parameters, most": f"{max(parameters)}",
        "tests, lines": f"{count_lines(ROOT / 'tests')}",
        "benchmarks, lines": f"{count_lines(ROOT / 'benchmarks')}",
        "pages, words": f"{sum(len(page.read_text(encoding='utf-8').split()) for page in pages())}",
    }


def python_files(folder: Path) -> list[Path]:
    """Return the Python files of a folder and its subfolders, sorted."""
    return sorted(path for path in folder.rglob("*.py") if "__pycache__" not in path.parts)


def pages() -> Iterator[Path]:
    """Yield the pages that people read: those of the root, of docs/, and the list of benchmarks."""
    yield from ROOT.glob("*.md")
    yield from (path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts)
    yield ROOT / "benchmarks" / "README.md"


def count_lines(folder: Path) -> int:
    """Return the lines of all Python files below a folder."""
    return sum(path.read_text(encoding="utf-8").count("\n") for path in python_files(folder))


def module_name(path: Path) -> str:
    """Return the dotted name of a module of the project."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def is_small(path: Path, text: str) -> bool:
    """Return whether a module is short; the files that make a folder a package do not count."""
    return path.name not in ("__init__.py", "__main__.py") and text.count("\n") < SMALL


def functions_in(tree: ast.AST) -> Iterator[ast.FunctionDef]:
    """Yield all functions, nested ones too."""
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def parameters_of(function: ast.FunctionDef) -> list[ast.arg]:
    """Return the parameters, without `self` and `cls`."""
    every = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    return [one for one in every if one.arg not in ("self", "cls")]


def complexity(function: ast.FunctionDef) -> int:
    """Return McCabe's cyclomatic complexity (1976): branches and Boolean operators plus one."""
    return 1 + sum(_weight(node) for node in ast.walk(function))


def _weight(node: ast.AST) -> int:
    if isinstance(node, ast.BoolOp):
        return len(node.values) - 1
    return int(isinstance(node, BRANCHES))


def count_numbers(tree: ast.Module) -> int:
    """Return how many constants at module level are numbers or tuples of numbers; A, B = 1, 2 are two."""
    count = 0
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            values = [node.value]
            if isinstance(target, ast.Tuple):
                values = node.value.elts if isinstance(node.value, ast.Tuple) else []
            count += sum(map(is_number, values))
    return count


def is_number(value: ast.expr) -> bool:
    """Return whether an expression is a number, arithmetic on numbers, or a sequence of them."""
    match value:
        case ast.Constant():
            return isinstance(value.value, int | float | complex) and not isinstance(value.value, bool)
        case ast.UnaryOp():
            return is_number(value.operand)
        case ast.BinOp():
            return is_number(value.left) and is_number(value.right)
        case ast.Tuple() | ast.List():
            return bool(value.elts) and all(map(is_number, value.elts))
    return False


def longest_chain(trees: dict[str, ast.Module], *, lazy: bool = True) -> int:
    """Return how many modules the longest chain of imports has; a cycle is followed once.

    Args:
        trees: all modules of the package by dotted name.
        lazy: whether imports inside functions count.
    """
    imports = {name: set(imported(name, tree, trees, lazy=lazy)) for name, tree in trees.items()}
    above: set[str] = set()

    @cache
    def length(name: str) -> int:
        above.add(name)
        longest = max((length(other) for other in imports[name] - above), default=0)
        above.discard(name)
        return 1 + longest

    return max(map(length, trees))


def imported(name: str, tree: ast.Module, modules: Iterable[str], *, lazy: bool) -> Iterator[str]:
    """Yield the modules of the package that a module imports, but itself."""
    for node in ast.walk(tree) if lazy else tree.body:
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            for one in node.names:
                whole = f"{node.module}.{one.name}"
                module = whole if whole in modules else node.module
                if module in modules and module != name:
                    yield module


if __name__ == "__main__":
    main()
