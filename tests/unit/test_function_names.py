"""Functions are named by a verb, or by the quantity that they give; never by a participle, an adverb or a clause."""

import ast
from pathlib import Path

import pytest

import sfm_app

PACKAGE = Path(sfm_app.__file__).parent
NOUNS = {"bed", "embed", "feed", "need", "red", "seed", "shed", "speed"}
"""Words in -ed that are no participles."""
IRREGULAR = """
    begun bent born broken built chosen done drawn fed felt found given gone grown held hidden kept known laid left lost
    made met seen sent shown sought spent taken thought told torn worn written
""".split()  # noqa: SIM905 -- a list reads worse
STARTS = """
    about across after again alone along always among apart around aside at away before behind beside between by down
    each else even evenly every few how in into just most much nearly not of off on once only or other out over own past
    perhaps rather so some still than that then there through together too twice under until up upon what when where
    which while who whole why within without
""".split()  # noqa: SIM905
"""Adverbs, prepositions and what begins a clause; constructors and converters may begin with from, to and with."""
TERMS = {
    "held_out_votes",
    "most_votes",
    "off_line_mask",
    "up_axes",
    "up_direction",
    "up_from_positions",
    "too_few_message",
}
"""Nouns of the field, and messages, that only look like one of these."""
PARTICLES = {*STARTS, "back", "from", "to", "with"}
"""What makes a participle a phrase instead of an adjective."""
PREDICATES = ("is_", "has_", "can_", "are_", "was_")


def function_names(path):
    """Functions and methods of a module; properties are named like attributes."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            marks = [ast.dump(mark) for mark in node.decorator_list]
            if not node.name.startswith("__") and not any("property" in mark or "hook" in mark for mark in marks):
                yield node.name


def is_participle(word):
    return (word.endswith("ed") and word not in NOUNS) or word in IRREGULAR


def offends(name):
    """Whether a function of this name is called after a state, a circumstance or a clause."""
    plain = name.strip("_")
    words = plain.split("_")
    if plain in TERMS or plain.startswith(PREDICATES):
        return False
    return words[0] in STARTS or (is_participle(words[0]) and (len(words) == 1 or words[1] in PARTICLES))


def test_functions_are_verbs_or_quantities():
    found = [
        (path.relative_to(PACKAGE).as_posix(), name) for path in PACKAGE.rglob("*.py") for name in function_names(path)
    ]
    assert len(found) > 1000
    assert [(file, name) for file, name in found if offends(name)] == []


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("refine", False),
        ("_refined", True),
        ("taken_apart", True),
        ("how_it_stands", True),
        ("evenly", True),
        ("of_pair", True),
        ("squared_distances", False),
        ("is_estimated", False),
        ("random_seed", False),
        ("from_pairs", False),
    ],
)
def test_the_rule_finds_what_it_is_for(name, bad):
    assert offends(name) == bad
