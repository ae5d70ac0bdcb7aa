import pickle

import pytest

from sfm_app import errors
from sfm_app.errors import SfmError

EVERY_ERROR = [SfmError, *SfmError.__subclasses__()]


@pytest.mark.parametrize("error", EVERY_ERROR)
def test_errors_cross_worker_processes(error):
    copy = pickle.loads(pickle.dumps(error("what", hint="how")))  # noqa: S301
    assert (type(copy), str(copy), copy.hint) == (error, "what", "how")


def test_exit_codes_are_distinct_and_drawn_in_the_tree():
    codes = [error.exit_code for error in EVERY_ERROR]
    assert sorted(codes) == [1, 2, 3, 4, 5, 6, 7, 8]
    assert all(error.__name__ in errors.__doc__ for error in EVERY_ERROR)
