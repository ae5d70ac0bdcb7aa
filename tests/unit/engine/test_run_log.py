"""What log.txt holds."""

import logging
import warnings

import pytest

from sfm_app.engine.execution import log_to_file


def test_warnings_of_python_stand_in_the_log(run):
    run.workspace.create()
    logging.captureWarnings(capture=True)
    try:
        with log_to_file(run), warnings.catch_warnings(action="always"):
            warnings.warn("invalid value in sqrt", RuntimeWarning, stacklevel=1)
    finally:
        logging.captureWarnings(capture=False)

    assert "RuntimeWarning: invalid value in sqrt" in run.workspace.log.read_text(encoding="utf-8")


def test_what_ends_a_run_stands_in_the_log_with_its_traceback(run):
    run.workspace.create()
    with pytest.raises(IndexError), log_to_file(run):
        raise IndexError("a bug of ours")

    text = run.workspace.log.read_text(encoding="utf-8")
    assert "the run ended here" in text and "Traceback" in text and "IndexError: a bug of ours" in text
