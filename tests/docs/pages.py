"""Pages, their fenced blocks, and the commands in them."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(path for path in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in path.parts),
    *sorted((ROOT / "plugins").glob("*/README.md")),
    *sorted((ROOT / "examples").rglob("*.md")),
]
FENCE = re.compile(r"^(<!-- compiled only: [^\n]+ -->\n\n?)?```(\S*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
SHELL = ("sh", "console")
ENDS = ("&&", "||", "|", ";")
"""After these a line has another command."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: Path
    line: int
    language: str
    text: str
    compiled_only: bool

    def __str__(self):
        return f"{self.page.relative_to(ROOT).as_posix()}:{self.line}"


def blocks(page):
    """Return all blocks of a page."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(page, text[: found.start(3)].count("\n"), found[2], found[3], bool(found[1]))
        for found in FENCE.finditer(text)
    ]


def commands(block):
    """Return the commands of a block, each as its words; of a session, what stands behind the prompts."""
    lines = block.text.replace("\\\n", " ").splitlines()
    if block.language == "console":
        lines = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
    found = []
    for line in lines:
        words = shlex.split(line, comments=True)
        for k, word in enumerate([*words, "&&"]):
            if word in ENDS:
                before = max((n for n in range(k) if words[n] in ENDS), default=-1)
                found.append(_without_redirection(words[before + 1 : k]))
    return [command for command in found if command]


def _without_redirection(words):
    at = next((k for k, word in enumerate(words) if word.startswith(">") or word == "2>"), len(words))
    return words[:at]
