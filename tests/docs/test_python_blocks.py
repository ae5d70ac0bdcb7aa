"""Blocks of Python on pages run beside photos/ and a finished run out/; examples in docstrings are true."""

import doctest
import inspect

import numpy as np
import pytest

import sfm_app
from sfm_app.synthetic.correspondences import PairOptions, TrackOptions, make_pair, make_tracks
from tests.docs.pages import PAGES, ROOT, blocks

ELSEWHERE = {ROOT / "docs" / "plugins.md"}
"""Its modules are installed and tried by tests/unit/test_pages.py."""
ALL = [block for page in PAGES for block in blocks(page) if block.language in ("python", "py")]
RUN = [block for block in ALL if not block.compiled_only and block.page not in ELSEWHERE]


@pytest.fixture(scope="module")
def names():
    """Make what blocks may use without saying where it is from: matches, fundamental matrices, the size of photos."""
    pair, tracks = make_pair(PairOptions(outliers=0.3), 1), make_tracks(TrackOptions(), 1)
    width, height = tracks.size
    matches = [np.hstack([views.x1, views.x2]) for views in list(tracks.pairs.values())[:3]]
    return {
        "np": np, "sfm_app": sfm_app, "x1": pair.x1, "x2": pair.x2, "Fs": tracks.F, "width": width, "height": height,
        "size": tracks.size, "matches": matches,
    }  # fmt: skip


@pytest.mark.parametrize("block", ALL, ids=str)
def test_it_compiles(block):
    compile(block.text, str(block), "exec")


@pytest.mark.slow
@pytest.mark.parametrize("block", RUN, ids=str)
def test_it_runs(block, names, beside_a_run, capsys):
    exec(compile("\n" * block.line + block.text, str(block.page), "exec"), dict(names))  # noqa: S102 - our own page


def test_few_are_only_compiled():
    assert len(RUN) >= 4
    assert sum(block.compiled_only for block in ALL) <= 3


NAMES = sorted(set(sfm_app.__all__) - {"__version__"})
FINDER = doctest.DocTestFinder(exclude_empty=True)


def examples(name):
    """The examples of a public name; those of a class include its methods'."""
    thing = getattr(sfm_app, name)
    return [test for test in FINDER.find(thing, name, globs={}) if test.examples]


WITH = [name for name in NAMES if examples(name)]


def test_every_function_has_an_example():
    functions = {name for name in NAMES if inspect.isfunction(getattr(sfm_app, name))}
    assert len(functions) >= 11
    assert functions <= set(WITH)


@pytest.mark.slow
@pytest.mark.parametrize("name", WITH)
def test_examples_are_true(name, beside_a_run):
    runner = doctest.DocTestRunner(optionflags=doctest.IGNORE_EXCEPTION_DETAIL)
    told = []
    for test in examples(name):
        runner.run(test, out=told.append)
    assert runner.failures == 0, "".join(told)
