"""What the pages say of flags, settings, exit codes, modules, plug-ins and equations is what the code has."""

import inspect
import pkgutil
import re
import sys
import tomllib
from dataclasses import fields
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_type_hints

import click
import cv2
import numpy as np
import pytest

import sfm_app
from sfm_app import errors, plugins
from sfm_app.cli.program import main
from sfm_app.errors import SfmError
from sfm_app.plugins import installed_plugins, load_plugins
from sfm_app.settings import QUALITY_PRESETS, EpipolarSettings, MatchSettings, Settings
from sfm_app.synthetic.correspondences import PairOptions, make_pair

ROOT = Path(__file__).parents[2]
ABOUT_MODULES = [
    path.relative_to(ROOT).as_posix()
    for folder in ("algorithms", "libraries")
    for path in sorted((ROOT / "docs" / folder).glob("*.md"))
]
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


def test_flags_that_are_named_are_there():
    printed = {flag for page in FOR_USERS for flag in re.findall(r"`(--[a-z-]+)", read(page))}
    assert len(printed) > 10
    assert printed - NOT_OURS <= flags()


def test_settings_that_are_named_exist():
    """`table.key` in code, where the table is one of the settings file."""
    tables = [name for name in Settings.model_fields if name not in ("seed", "workers", "quality", "plugins", "report")]
    named = [(page, *pair) for page in PAGES for pair in re.findall(rf"`({'|'.join(tables)})\.([a-z_]+)`", read(page))]
    assert len(named) > 10
    for page, table, key in named:
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


def modules_named_on(page):
    """What stands in code as `package/module.py`, `package/module.function` or `package.module.function`."""
    packages = "|".join(sorted(path.parent.name for path in (ROOT / "sfm_app").glob("*/__init__.py")))
    return re.findall(rf"`((?:{packages})(?:(?:/\w+)+(?:\.\w+)?|\.\w+\.\w+))`", read(page))


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", *ABOUT_MODULES])
def test_modules_that_are_named_exist(page):
    for name in modules_named_on(page):
        pkgutil.resolve_name(f"sfm_app.{name.removesuffix('.py').replace('/', '.')}")


SKIPPED = {".venv", "node_modules", ".git", "build", "dist", "demo", "_build", ".pytest_cache"}
LINK = re.compile(r"!?\[[^\]]*\]\(([^()\s]+(?:\([^()\s]*\)[^()\s]*)*)(?: \"[^\"]*\")?\)")
FILES = sorted(path for path in ROOT.rglob("*.md") if not path.is_symlink())
MARKDOWN = [path for path in FILES if not SKIPPED & set(path.relative_to(ROOT).parts)]


def links(page):
    """The relative links of a page, code left out."""
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return [link for link in LINK.findall(text) if not re.match(r"[a-z]+:", link)]


def anchors(page):
    """What the headings of a page are called in links."""
    headings = re.findall(r"^#+ +(.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def is_dead(page, link):
    """Whether a link leads to no file, or to no heading of it."""
    path, _, anchor = link.partition("#")
    target = page.parent / path if path else page
    return not target.exists() or bool(anchor and target.suffix == ".md" and anchor not in anchors(target))


def test_no_link_is_dead():
    found = [(page.relative_to(ROOT).as_posix(), link) for page in MARKDOWN for link in links(page)]
    assert len(found) > 200
    assert [(page, link) for page, link in found if is_dead(ROOT / page, link)] == []


def test_every_picture_of_the_results_is_on_a_page():
    results = ROOT / "benchmarks" / "results"
    shown = {(page.parent / link).resolve() for page in MARKDOWN for link in links(page)}
    assert [path.name for path in sorted(results.glob("*.png")) if path.resolve() not in shown] == []
    assert {path.suffix for path in results.iterdir()} <= {".json", ".md", ".png"}


PAGE = ROOT / "docs" / "plugins.md"


def block(language, number=0):
    """Return a fenced block by its language, "" for none."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return [text for kind, text in blocks if kind == language][number]


def test_the_printed_estimator_works(tmp_path, monkeypatch):
    entry = tomllib.loads(block("toml"))["project"]["entry-points"]["sfm_app"]["my-estimator"]
    (tmp_path / f"{entry}.py").write_text(block("python"), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    module = __import__(entry)
    monkeypatch.delitem(sys.modules, entry)
    pair = make_pair(PairOptions(points=300, outliers=0.2), 1)
    found = load_plugins([module], installed=False).estimator("my-magsac").fit(pair.x1, pair.x2, EpipolarSettings(), 0)
    assert found.inliers[pair.is_inlier].mean() > 0.5
    assert found.inliers[~pair.is_inlier].mean() < 0.1


def test_the_printed_features_work(tmp_path, monkeypatch):
    (tmp_path / "my_features.py").write_text(block("python", 2), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    module = __import__("my_features")
    monkeypatch.delitem(sys.modules, "my_features")
    method, options = load_plugins([module], installed=False).feature_method("my-orb"), MatchSettings(max_features=500)
    blots = np.random.default_rng(0).uniform(0, 255, (30, 40, 3)).astype(np.uint8)
    picture = cv2.resize(blots, (320, 240), interpolation=cv2.INTER_NEAREST)

    first, second = (method.find(np.roll(picture, step, axis=1), options) for step in (0, 8))
    rows = method.match(first, second, options)

    assert 100 <= len(rows) <= len(first) <= 500
    steps = second.keypoints[rows[:, 1]] - first.keypoints[rows[:, 0]]
    np.testing.assert_allclose(np.median(steps, axis=0), (8, 0), atol=0.5)  # ORB rounds on its smaller levels
    white = np.full((60, 80, 3), 255, np.uint8)
    assert len(method.find(white, options)) == 0


def fundamentals(rng, count, focal, size):
    """Return (count, 3, 3) matrices of random poses, all but exact, with the optical center in the middle."""
    inverse = np.linalg.inv(np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]]))
    rotations = (cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0] for _ in range(count))
    essentials = np.array([np.cross(np.eye(3), rng.normal(size=3)).T @ R for R in rotations])
    return inverse.T @ (essentials + rng.normal(0, 1e-4, essentials.shape)) @ inverse


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install the printed calibrator as a package does: with an entry point."""
    (tmp_path / "my_calibrator.py").write_text(block("python", 1), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    package = SimpleNamespace(entry_points=[metadata.EntryPoint("my", "my_calibrator", "sfm_app")])
    monkeypatch.setattr(metadata, "distributions", lambda: [package])
    installed_plugins.cache_clear()
    yield
    installed_plugins.cache_clear()
    sys.modules.pop("my_calibrator", None)


def test_the_printed_calibrator_works(installed):
    rng, size = np.random.default_rng(0), (1000, 750)
    found = sfm_app.calibrate_fundamentals(fundamentals(rng, 12, 1100.0, size), size, method="my-focal")
    of_noise = sfm_app.calibrate_fundamentals(rng.normal(size=(12, 3, 3)), size, method="my-focal")
    assert (found.identifiable, found.method, found.reason) == (True, "my-focal", "")
    np.testing.assert_allclose(np.diag(found.K)[:2], 1100, rtol=0.03)
    assert found.evidence["median_ratio"] < 0.01
    assert not of_noise.identifiable and of_noise.reason


TEXT, MAP = read("docs/symbols.md"), read("docs/thesis-map.md")
COMMAND = "python -m "
NAMES = sorted({name for name in re.findall(r"`([^`]+)`", TEXT + MAP) if not name.startswith(COMMAND)} - {"sfm_app"})
LAST_EQUATIONS = {2: 38, 3: 22, 4: 18, 5: 35}
"""The last numbered equation of each chapter of the thesis."""
METHODS = {name for kind in ("estimators", "calibrators") for name in getattr(load_plugins(installed=False), kind)}


def exists(name):
    """Whether `package.module.Class.member` or `package.module.function(variable)` is in the code, or a method."""
    path, _, variable = name.removesuffix(")").partition("(")
    owner, _, last = f"sfm_app.{path}".rpartition(".")
    try:
        if last in getattr(pkgutil.resolve_name(owner), "__annotations__", ()):
            return not variable
        found = pkgutil.resolve_name(f"{owner}.{last}")
    except (ImportError, AttributeError, ValueError):
        return path in METHODS
    if getattr(found, "__qualname__", "") and not f"sfm_app.{path}".startswith(found.__module__):
        return False
    return (
        not variable or re.search(rf"\b{variable}\b", inspect.getsource(getattr(found, "py_func", found))) is not None
    )


def test_every_name_on_the_page_is_in_the_code():
    assert len(NAMES) > 150
    assert [name for name in NAMES if not exists(name)] == []


def test_the_hooks_are_printed_with_their_fields():
    printed = block("")
    for hook in (name for name in vars(plugins.Hooks) if name.startswith("sfm_")):
        (kind,) = get_args(get_type_hints(getattr(plugins.Hooks, hook))["return"])
        assert f"{hook}() -> Iterable[{kind.__name__}]\n" in printed
        (call,) = re.findall(rf"^    {kind.__name__}\((.*)\)$", printed, re.MULTILINE)
        assert re.findall(r"(?:^|, )(\w+): ", call) == [field.name for field in fields(kind)]


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


def test_every_function_on_the_map_is_a_path():
    """A bare word would pass for the name of a method."""
    names = {name for name in re.findall(r"`([^`]+)`", MAP) if not name.startswith(COMMAND)}
    methods = {name for name in names if "." not in name}
    assert methods == {
        "sfm_app", "lev-ransac", "lev-ransac-thesis", "multi-start", "perturbation", "zero-curves",
        "zero-curves-thesis",
    }  # fmt: skip
