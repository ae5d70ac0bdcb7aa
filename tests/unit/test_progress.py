"""Progress told to a function."""

import pytest

from sfm_app.progress import CallbackProgress, SilentProgress, Step, as_progress, track


def test_a_function_is_called_with_every_step():
    steps = []
    progress = as_progress(steps.append)
    progress.stage("scene", "as asked")
    for _ in track(progress, range(2), "mapping", 2):
        pass
    progress.say("7 photos")

    assert steps == [
        Step("scene", "as asked", 0, 0),
        Step("scene", "mapping", 0, 2),
        Step("scene", "mapping", 1, 2),
        Step("scene", "mapping", 2, 2),
        Step("scene", "7 photos", 0, 0),
    ]


def test_an_exception_of_the_function_ends_the_work():
    def stop(step):
        if step.done == 2:
            raise RuntimeError("enough")

    done = []
    with pytest.raises(RuntimeError, match="enough"):
        done += track(as_progress(stop), range(9), "mapping", 9)
    assert done == [0, 1]


def test_a_display_is_taken_as_it_is_and_nothing_is_silence():
    shown = CallbackProgress(print)
    assert as_progress(shown) is shown
    assert isinstance(as_progress(None), SilentProgress)
