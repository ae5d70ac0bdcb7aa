"""Examples in the docstrings of public names give what they print."""

import doctest
import inspect

import pytest

import sfm_app

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
