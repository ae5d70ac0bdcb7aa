"""Progress of long work, whatever displays it."""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, TypeVar

Item = TypeVar("Item")
UP_TO_DATE = "up to date"
"""Note of a stage that is skipped."""


class Progress:
    """A display of progress, which shows only what a subclass shows; the command line has one on stderr."""

    def stage(self, name: str, note: str = "") -> None:
        """Announce a stage; the note says why it is skipped or repeated."""

    def finish_stage(self, seconds: float, photos: int = 0) -> None:
        """Announce the duration of the current stage, and its number of photos, if relevant."""

    def say(self, text: str) -> None:
        """Show a message."""

    def start(self, label: str, total: int) -> None:
        """Start work of several steps with this label."""

    def advance(self, steps: int = 1) -> None:
        """Count more steps as done."""

    def finish(self) -> None:
        """Finish the work started last."""


class Step(NamedTuple):
    """Progress of a run, for a callback."""

    stage: str
    """Name of the current stage, as in the manifest; empty before the first."""
    label: str
    """Label of the work, or a message."""
    done: int
    """Finished steps of the current work."""
    total: int
    """Steps of the current work; 0 for a new stage or a message."""


Callback = Callable[[Step], None]


class CallbackProgress(Progress):
    """A display that calls a function with every step, in the thread of the run."""

    def __init__(self, callback: Callback) -> None:
        self.callback = callback
        self.now = Step("", "", 0, 0)

    def stage(self, name: str, note: str = "") -> None:
        """Announce a stage."""
        self._report(Step(name, note, 0, 0))

    def say(self, text: str) -> None:
        """Announce a message."""
        self.callback(Step(self.now.stage, text, 0, 0))

    def start(self, label: str, total: int) -> None:
        """Announce work that begins."""
        self._report(Step(self.now.stage, label, 0, total))

    def advance(self, steps: int = 1) -> None:
        """Count finished steps."""
        self._report(self.now._replace(done=self.now.done + steps))

    def _report(self, step: Step) -> None:
        self.now = step
        self.callback(step)


def as_progress(display: Progress | Callback | None) -> Progress:
    """Return a display for a display, a callback, or None (silence)."""
    if display is None:
        return Progress()
    return CallbackProgress(display) if callable(display) else display


def track(progress: Progress, items: Iterable[Item], label: str, total: int) -> Iterator[Item]:
    """Yield the items and count each one when the caller is done with it."""
    progress.start(label, total)
    try:
        for item in items:
            yield item
            progress.advance()
    finally:
        progress.finish()
