"""The site has all pages, names, commands, settings and files of a run, and asks nothing of other hosts."""

import importlib.util
import json
import re
import subprocess
import sys

import click
import pytest

import sfm_app
from sfm_app.cli.program import main
from sfm_app.runtime.workspace import CHECKSUM, StageRecord
from sfm_app.settings import Section, Settings
from tests.docs.pages import ROOT

DOCS = ROOT / "docs"
REFERENCE = "\n".join(path.read_text(encoding="utf-8") for path in sorted((DOCS / "reference").glob("*.md")))
HAS_SPHINX = all(importlib.util.find_spec(name) is not None for name in ("sphinx", "myst_parser", "furo"))
LOADED = re.compile(r"<(?:script|img|iframe|source|link)\b[^>]*\b(?:src|href)=\"([^\"]+)\"")
"""What a browser fetches by itself; links that people click are no matter."""


@pytest.fixture(scope="module")
def tools():
    """The modules of docs/_ext that make pages."""
    sys.path.insert(0, str(DOCS / "_ext"))
    try:
        import generated
        import site_pages

        yield generated, site_pages
    finally:
        sys.path.remove(str(DOCS / "_ext"))


@pytest.fixture(scope="module")
def laid_out(tools, tmp_path_factory):
    """All pages, as Sphinx takes them."""
    target = tmp_path_factory.mktemp("site")
    return target, tools[1].lay_out(target, tools[0].GENERATORS)


def test_every_public_name_is_on_a_page():
    directive = r"auto(?:function|class|exception|data):: (?:sfm_app\.)?([A-Za-z_]+)(?:\(\))?$"
    shown = set(re.findall(directive, REFERENCE, re.MULTILINE))
    assert set(sfm_app.__all__) <= shown


def test_every_command_and_option_is_on_a_page(tools):
    text = tools[0].commands() + tools[0].setting_options()
    context = click.Context(main)
    for name in main.list_commands(context):
        command = main.get_command(context, name)
        assert f"## sfm-app {name}" in text
        if not isinstance(command, click.Group):
            shown = [part for part in command.params if not getattr(part, "hidden", False)]
            assert all(option in text for part in shown for option in part.opts if option.startswith("--"))


def test_every_setting_is_on_a_page(tools):
    text = tools[0].settings()
    for name, field in Settings.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, Section):
            assert f"## {name}\n" in text
            assert all(f"#setting-{name}-{key.replace('_', '-')}" in text for key in kind.model_fields)
        else:
            assert f"#setting-{name.replace('_', '-')}" in text


def test_a_default_that_depends_on_the_quality_is_given_for_each(tools):
    row = next(line for line in tools[0].settings().splitlines() if "#setting-mesh-faces" in line)
    assert "`50000` (draft), `200000` (normal), `1000000` (high)" in row
    assert "`100<=x<=50000000`" in row


def test_exit_codes_are_in_order_and_each_has_a_meaning(tools):
    rows = re.findall(r"^\| (\d+) \| [^|]* \| ([^|]+) \|$", tools[0].exit_codes(), re.MULTILINE)
    assert [int(code) for code, _ in rows] == [0, 1, 2, 3, 3, 4, 5, 6, 7, 8, 130]
    assert all(meaning.strip() for _, meaning in rows)


def test_every_place_for_generated_text_is_filled(laid_out):
    target, names = laid_out
    pages = [target / name for name in names if name.suffix == ".md"]
    assert len(pages) > 80
    assert not [page for page in pages if re.search(r"^<!-- here:", page.read_text(encoding="utf-8"), re.MULTILINE)]


def test_links_are_those_of_the_site(laid_out):
    target, names = laid_out
    for name in (name for name in names if name.suffix == ".md"):
        text = re.sub(r"```.*?```|`[^`\n]*`", "", (target / name).read_text(encoding="utf-8"), flags=re.DOTALL)
        for link in re.findall(r"\]\(([^()\s]+)\)", text):
            if not re.match(r"[a-z]+:|#", link):
                assert (target / name.parent / link.partition("#")[0]).exists(), f"{name}: {link}"


def test_a_second_time_nothing_is_written(laid_out, tools):
    target, names = laid_out
    before = {name: (target / name).stat().st_mtime_ns for name in names}
    (target / "left over.md").write_text("of an earlier build")
    assert tools[1].lay_out(target, tools[0].GENERATORS) == names
    assert {name: (target / name).stat().st_mtime_ns for name in names} == before
    assert not (target / "left over.md").exists()


def test_links_are_moved_and_code_is_not(tools):
    page = DOCS / "how-to" / "video.md"
    text = "[a](../../benchmarks/README.md#rules) `[b](../../x.md)` [c](../../examples) [d](https://a.org/x) [e](#f)"
    moved = tools[1].relink(text, page, [ROOT / "benchmarks" / "README.md"], set())
    assert moved == "[a](../benchmarks/README.md#rules) `[b](../../x.md)` c [d](https://a.org/x) [e](#f)"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built with warnings as errors."""
    if not HAS_SPHINX:
        pytest.skip("the extra `docs` is not installed: pip install -e '.[docs]'")
    target = tmp_path_factory.mktemp("built")
    command = [sys.executable, str(DOCS / "build.py"), str(target)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return target / "html"


@pytest.mark.slow
def test_no_page_asks_other_hosts(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 80
    for page in pages:
        fetched = LOADED.findall(page.read_text(encoding="utf-8"))
        assert fetched
        assert [link for link in fetched if re.match(r"(?:https?:)?//", link)] == [], page.name
    for style in site.rglob("*.css"):
        assert not re.search(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//", style.read_text(encoding="utf-8")), style.name


@pytest.mark.slow
def test_the_search_knows_the_pages_and_docstrings_are_on_them(site):
    index = (site / "searchindex.js").read_text(encoding="utf-8")
    words = ("how-to/turntable", "reference/estimators", "estimate_fundamental", "turntabl")
    assert all(word in index for word in words)
    assert (site / "search.html").exists()
    text = (site / "reference" / "estimators.html").read_text(encoding="utf-8")
    assert 'id="sfm_app.estimate_fundamental"' in text
    assert "many of which may be wrong" in text
    assert 'href="results.html#sfm_app.EpipolarFit"' in text


PAGE = (ROOT / "docs" / "reference" / "output-files.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| (`[^|]+) \|", PAGE, re.MULTILINE)
NAMED = {name.rstrip("/") for row in ROWS for name in re.findall(r"`([^`]+)`", row)}


def test_every_entry_of_a_record_is_listed():
    assert {*StageRecord.__dataclass_fields__, CHECKSUM} <= NAMED


@pytest.mark.slow
def test_every_file_of_a_run_and_every_entry_of_its_manifest_are_listed(finished):
    left = {path.name for path in (finished / "out").iterdir() if not path.name.startswith(".")}
    assert {"model.glb", "report.html", "manifest.json"} <= left
    assert left <= NAMED
    manifest = json.loads((finished / "out" / "manifest.json").read_text(encoding="utf-8"))
    assert set(manifest) <= NAMED
    assert all(set(record) <= NAMED for record in manifest["stages"].values())
