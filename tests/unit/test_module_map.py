"""The map of the house in docs/architecture.md names every module, where it is."""

import re
from pathlib import Path

import sfm_app

PACKAGE = Path(sfm_app.__file__).parent
PAGE = Path(__file__).parents[2] / "docs" / "architecture.md"


def rooms():
    """The text of every room on the map, by its path such as "ransac/scoring"."""
    tree = PAGE.read_text(encoding="utf-8").split("```\nsfm_app/\n")[1].split("```")[0]
    found, above = {}, ""
    for line in tree.split("\ntests/")[0].splitlines():
        head = re.match(r"(  |    )([a-z_0-9]+)(/|\.py)\s+(.*)", line)
        if head:
            indent, name, kind, text = head.groups()
            room = f"{above}/{name}" if len(indent) == 4 else name
            above = above if len(indent) == 4 else name
            found[room + (".py" if kind == ".py" else "")] = text
        else:
            found[room] += " " + line.strip()
    return found


def modules():
    """Every module but the packages' own, as room and name."""
    paths = (path.relative_to(PACKAGE) for path in sorted(PACKAGE.rglob("*.py")))
    return [
        (path.parent.as_posix(), path.stem)
        for path in paths
        if path.name not in ("__init__.py", "__main__.py") and "__pycache__" not in path.parts
    ]


def is_on(found, room, module):
    """Whether the map has a module."""
    return f"{module}.py" in found if room == "." else bool(re.search(rf"\b{module}\b", found.get(room, "")))


def test_every_module_is_on_the_map():
    found, all_of_them = rooms(), modules()
    assert len(all_of_them) > 300
    assert [f"{room}/{module}" for room, module in all_of_them if not is_on(found, room, module)] == []


def test_nothing_on_the_map_is_gone():
    for room in rooms():
        assert (PACKAGE / room).exists(), f"{room} is on the map only"
