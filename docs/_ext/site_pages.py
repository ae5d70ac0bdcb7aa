"""Lay out the pages of the site: those of docs/ and others of the repository, with links that hold on both."""

import os
import re
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
OUTSIDE = (
    "CHANGELOG.md", "CONTRIBUTING.md", "benchmarks/README.md", "benchmarks/results/*.md", "plugins/*/README.md",
    "examples/README.md", "examples/*/README.md",
)  # fmt: skip
"""Pages that are not in docs/; they get the same path on the site."""
FRONT = {"README.md": "index.md"}
"""The README is the front page of the repository; the site has one of its own."""
NAVIGATION = {
    "libraries/README.md": "*", "benchmarks/README.md": "results/*", "plugins.md": "plugins/*/README",
    "scripting.md": "examples/README", "examples/README.md": "*/README",
}  # fmt: skip
"""Pages of the site that stand above others, and which."""
LINK = re.compile(r"(!?\[(?:[^\[\]]|\[[^\]]*\])*\]\()([^()\s]+)((?: \"[^\"]*\")?\))")
CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)
MARK = re.compile(r"^<!-- here: ([a-z ]+) -->$", re.MULTILINE)
"""Where generated text goes."""

Generators = dict[str, Callable[[], str]]


def pages() -> list[Path]:
    """Return all pages of the site, by their places in the repository."""
    own = [path for path in sorted(DOCS.rglob("*.md")) if not path.relative_to(DOCS).parts[0].startswith("_")]
    return own + [path for pattern in OUTSIDE for path in sorted(ROOT.glob(pattern))]


def place_on_site(path: Path) -> Path:
    """Return where a file of the repository lies on the site.

    Args:
        path: below the root of the repository.
    """
    name = path.relative_to(ROOT).as_posix()
    return Path(FRONT.get(name) or (path.relative_to(DOCS) if path.is_relative_to(DOCS) else path.relative_to(ROOT)))


def lay_out(target: Path, generators: Generators) -> list[Path]:
    """Write every page and what it links to; only what has changed, so that a second build is fast.

    Args:
        target: folder of the pages, as Sphinx takes it.
        generators: by name, what makes the text in the place of `<!-- here: NAME -->`.

    Returns:
        The files written or kept, relative to `target`.
    """
    sources = pages()
    known = {path.resolve() for path in sources} | {(ROOT / name).resolve() for name in FRONT}
    kept = set()
    for page in sources:
        linked: set[Path] = set()
        text = relink(page.read_text(encoding="utf-8"), page, known, linked)
        text = MARK.sub(lambda mark: generators[mark[1]](), text)
        if below := NAVIGATION.get(place_on_site(page).as_posix()):
            text += f"\n```{{toctree}}\n:hidden:\n:glob:\n\n{below}\n```\n"
        kept.add(_write(target, place_on_site(page), text.encode()))
        kept |= {_write(target, place_on_site(path), path.read_bytes()) for path in linked}
    for folder in ("_static",):
        kept |= {_write(target, place_on_site(p), p.read_bytes()) for p in (DOCS / folder).rglob("*") if p.is_file()}
    _remove_others(target, kept)
    return sorted(kept)


def relink(text: str, page: Path, known: Iterable[Path], linked: set[Path]) -> str:
    """Return the text of a page with its relative links as they are on the site.

    Args:
        text: Markdown.
        page: where it lies in the repository.
        known: pages of the site, in the repository.
        linked: filled with other files that the page links to.
    """

    def moved(match: re.Match[str]) -> str:
        before, link, after = match.groups()
        path, hash_, anchor = link.partition("#")
        if not path or re.match(r"[a-z]+:", link):
            return match[0]
        found = (page.parent / path).resolve()
        if found.is_dir():  # the site has no page of a folder
            return before.removesuffix("](").removeprefix("[")
        if found not in known:
            linked.add(found)
        there = os.path.relpath(place_on_site(found), place_on_site(page).parent)
        return f"{before}{Path(there).as_posix()}{hash_}{anchor}{after}"

    parts = CODE.split(text)
    return "".join(part if CODE.fullmatch(part) else LINK.sub(moved, part) for part in parts)


def _write(target: Path, name: Path, content: bytes) -> Path:
    """Write a file unless it has that content, and return its name."""
    path = target / name
    if not path.exists() or path.read_bytes() != content:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return name


def _remove_others(target: Path, kept: set[Path]) -> None:
    """Remove what an earlier build has laid out and this one has not."""
    for path in sorted(target.rglob("*"), reverse=True):
        if path.is_file() and path.relative_to(target) not in kept:
            path.unlink()
        elif path.is_dir() and not any(path.iterdir()):
            shutil.rmtree(path)
