"""Relative links of all pages lead somewhere, and so do their anchors; others are well-formed, to known hosts."""

import re
from pathlib import Path
from urllib.parse import urlsplit

ROOT = Path(__file__).parents[2]
SKIPPED = {".venv", "node_modules", ".git", "build", "dist", "demo", "_build", ".pytest_cache"}
HOSTS = {
    "docs.astral.sh", "docs.dask.org", "github.com", "jobqueue.dask.org", "keepachangelog.com", "kubernetes.dask.org",
    "pipx.pypa.io", "semver.org",
}  # fmt: skip
"""Others are entered here by whoever has looked at the page; nothing is asked of them during tests."""
LINK = re.compile(r"!?\[[^\]]*\]\(([^()\s]+(?:\([^()\s]*\)[^()\s]*)*)(?: \"[^\"]*\")?\)")
PAGES = [
    path
    for path in sorted(ROOT.rglob("*.md"))
    if not SKIPPED & set(path.relative_to(ROOT).parts) and not path.is_symlink()
]


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
    found = [(page.relative_to(ROOT).as_posix(), link) for page in PAGES for link in links(page)]
    assert len(found) > 200
    assert [(page, link) for page, link in found if is_dead(ROOT / page, link)] == []


def external_links(page):
    """The links of a page to other hosts, code left out."""
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return re.findall(r"\bhttps?:[^\s)>\]]*", text)


def test_other_hosts_are_known():
    found = [(page.relative_to(ROOT).as_posix(), link) for page in PAGES for link in external_links(page)]
    assert len(found) > 5
    assert [(page, link) for page, link in found if urlsplit(link).hostname not in HOSTS] == []
    assert [(page, link) for page, link in found if urlsplit(link).scheme != "https"] == []


def test_every_picture_of_the_results_is_on_a_page():
    results = ROOT / "benchmarks" / "results"
    shown = {(page.parent / link).resolve() for page in PAGES for link in links(page)}

    assert [path.name for path in sorted(results.glob("*.png")) if path.resolve() not in shown] == []
    assert {path.suffix for path in results.iterdir()} <= {".json", ".md", ".png"}
