"""Docstrings of functions begin with what they do: a verb, then its object."""

import ast
from pathlib import Path

import sfm_app

PACKAGE = Path(sfm_app.__file__).parent
VERBS = """
    Add Adjust Announce Apply Average Begin Blur Bring Build Call Change Check Choose Claim Collapse Collect Compile
    Compute Continue Copy Count Decode Decompose Describe Divide Do Draw Drop Eliminate End Enter Estimate Even Expect
    Fill Find Finish Fit Fuse Give Go Group Hold Import Improve Invert Join Judge Keep Kill Lay Learn Leave Let Lift
    Link List Load Look Make Map Mark Match Measure Minimize Mix Move Note Open Paint Pass Photograph Pickle Place
    Prepare Print Project Provide Put Raise Rank Read Rebuild Reconstruct Refine Refit Refuse Register Release Remove
    Render Replace Return Round Run Sample Say Score Send Serve Set Show Simplify Solve Sort Span Spread Start Stop
    Sum Swap Take Tilt Turn Undistort Update Use Verify Wait Walk Warp Weigh Widen Write Yield
""".split()  # noqa: SIM905 -- a list of a hundred lines reads worse
"""A new verb is entered here; a noun, a participle or a fragment is not."""


def first_words(path):
    """The first words of docstrings by function, nested ones too; properties are named like what they give."""
    found = {}
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        text = ast.get_docstring(node) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) else None
        if text and not any("property" in ast.dump(decorator) for decorator in node.decorator_list):
            found[f"{node.name}, line {node.lineno}"] = text.split()[0].rstrip(",.:;")
    return found


def test_the_first_word_is_a_verb():
    found = {path.relative_to(PACKAGE).as_posix(): first_words(path) for path in PACKAGE.rglob("*.py")}
    assert sum(map(len, found.values())) > 1000
    assert [(file, *word) for file, words in found.items() for word in words.items() if word[1] not in VERBS] == []
