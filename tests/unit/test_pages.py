"""What the pages say of flags, settings, exit codes, layers and modules is what the code has."""

import pkgutil
import re
import tomllib
from pathlib import Path

import click
import pytest

from sfm_app import errors
from sfm_app.cli import main
from sfm_app.cli.options import parse_assignment
from sfm_app.errors import SfmError
from sfm_app.settings import QUALITY_PRESETS, Settings

ROOT = Path(__file__).parents[2]
LIBRARIES = [path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs" / "libraries").glob("*.md"))]
PAGES = ["README.md"] + [
    page
    for path in sorted((ROOT / "docs").rglob("*.md"))
    if not (page := path.relative_to(ROOT).as_posix()).startswith(
        ("docs/decisions/", "docs/_build/", "docs/odd-inputs")
    )
]
"""What the program is like today; decisions may name what is gone, and odd inputs are refused."""
FOR_USERS = ("README.md", "docs/scripting.md", "docs/troubleshooting.md", "docs/tutorial.md", "docs/real-size.md")
NOT_OURS = {"--left-out", "--sets", "--without"}
"""Flags of benchmarks."""


def read(page):
    return (ROOT / page).read_text(encoding="utf-8")


def flags():
    """Every long flag of every command."""
    context = click.Context(main)
    commands = [main.get_command(context, name) for name in main.list_commands(context)]
    return {flag for command in commands for parameter in command.params for flag in parameter.opts}


@pytest.mark.parametrize("page", PAGES)
def test_commands_that_are_printed_have_these_flags(page):
    """In a span of code or a block, after `sfm-app`, up to the end of the command."""
    calls = re.findall(r"sfm-app (?:[a-z]+ )[^`\n#|;&]*", read(page))
    printed = {flag for call in calls for flag in re.findall(r"(?<!\S)--[a-z-]+", call)}
    assert printed <= flags() | {"--help", "--version"}


def test_flags_that_are_named_are_there():
    printed = {flag for page in FOR_USERS for flag in re.findall(r"`(--[a-z-]+)", read(page))}
    assert len(printed) > 10
    assert printed - NOT_OURS <= flags()


@pytest.mark.parametrize("page", PAGES)
def test_settings_that_are_printed_can_be_set(page):
    for assignment in re.findall(r"--set ([a-z_]+\.[a-z_]+=[^\s`]+)", read(page)):
        Settings.from_mapping(parse_assignment(assignment))


@pytest.mark.parametrize("page", PAGES)
def test_settings_that_are_named_exist(page):
    """`table.key` in code, where the table is one of the settings file."""
    tables = [name for name in Settings.model_fields if name not in ("seed", "workers", "quality", "plugins", "report")]
    for table, key in re.findall(rf"`({'|'.join(tables)})\.([a-z_]+)`", read(page)):
        if key != "json" and not (ROOT / "sfm_app" / table / f"{key}.py").exists():
            assert key in type(getattr(Settings(), table)).model_fields, f"{page}: {table}.{key}"


def test_the_presets_are_those_of_the_settings():
    assert f"--quality {'|'.join(QUALITY_PRESETS)}" in read("docs/scripting.md")


def test_exit_codes_are_those_of_the_errors():
    table = read("docs/scripting.md").split("| code |")[1]
    printed = {int(code) for code in re.findall(r"^\| (\d+) \|", table, re.MULTILINE)}
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, SfmError)]
    assert printed == {0, 130} | {kind.exit_code for kind in kinds if kind is not SfmError}


def test_layers_are_those_that_import_linter_checks():
    contracts = tomllib.loads(read("pyproject.toml"))["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    printed = re.search(r"Imports go down only;[^\n]*\n\n```\n(.*?)```", read("docs/architecture.md"), re.DOTALL)
    assert printed is not None
    assert printed[1].split("\n")[:-1] == layers


def test_every_page_of_a_library_is_in_their_table():
    table = read("docs/libraries/README.md")
    rows = re.findall(r"^\| \[([a-z0-9-]+\.md)\]\(([a-z0-9-]+\.md)\) \|", table, re.MULTILINE)
    assert all(name == target for name, target in rows)
    pages = {page.removeprefix("docs/libraries/") for page in LIBRARIES} - {"README.md"}
    assert len(pages) > 1
    assert sorted(name for name, _ in rows) == sorted(pages)


def modules_named_on(page):
    """What stands in code as `package/module.py`, `package/module.function` or `package.module.function`."""
    packages = "|".join(sorted(path.parent.name for path in (ROOT / "sfm_app").glob("*/__init__.py")))
    return re.findall(rf"`((?:{packages})(?:(?:/\w+)+(?:\.\w+)?|\.\w+\.\w+))`", read(page))


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", *LIBRARIES])
def test_modules_that_are_named_exist(page):
    for name in modules_named_on(page):
        pkgutil.resolve_name(f"sfm_app.{name.removesuffix('.py').replace('/', '.')}")


def test_pages_of_libraries_name_modules():
    assert sum(len(modules_named_on(page)) for page in LIBRARIES) > 5
