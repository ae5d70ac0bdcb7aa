"""The interface through which long work reports its progress, whatever displays it."""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, Protocol, TypeVar

Item = TypeVar("Item")


class Progress(Protocol):
    """Interface of a display of progress; the command line has one on stderr, a library call none."""

    def stage(self, name: str, note: str = "") -> None:
        """Announce a stage that begins or was skipped.

        Args:
            name: of the stage.
            note: why it is skipped or done again; empty where it is new.
        """

    def finish_stage(self, seconds: float, photos: int = 0) -> None:
        """Announce the end of the current stage.

        Args:
            seconds: its duration.
            photos: photos in use; 0 where they do not matter.
        """

    def say(self, text: str) -> None:
        """Show a message."""

    def start(self, label: str, total: int) -> None:
        """Start work of several steps.

        Args:
            label: what is done, for people.
            total: number of steps.
        """

    def advance(self, steps: int = 1) -> None:
        """Count more steps as done."""

    def finish(self) -> None:
        """Finish the work that was started last."""


class SilentProgress:
    """A display that shows nothing."""

    def stage(self, name: str, note: str = "") -> None:
        """Show nothing.

        Args:
            name, note: not used.
        """

    def finish_stage(self, seconds: float, photos: int = 0) -> None:
        """Show nothing.

        Args:
            seconds, photos: not used.
        """

    def say(self, text: str) -> None:
        """Show nothing."""

    def start(self, label: str, total: int) -> None:
        """Show nothing.

        Args:
            label, total: not used.
        """

    def advance(self, steps: int = 1) -> None:
        """Show nothing."""

    def finish(self) -> None:
        """Show nothing."""


class Step(NamedTuple):
    """How far a run has come, for a callback."""

    stage: str
    """Name of the current stage, as in the manifest; empty before the first."""
    label: str
    """What is done, or a message, for people."""
    done: int
    """Steps of the current work that are done."""
    total: int
    """Steps of the current work; 0 where it has none: a stage that begins, a message."""


Callback = Callable[[Step], None]


class CallbackProgress(SilentProgress):
    """A display that calls a function with every step; an exception from it ends the run, which can be resumed.

    Args:
        callback: called in the thread that started the run.
    """

    def __init__(self, callback: Callback) -> None:
        self.callback = callback
        self.now = Step("", "", 0, 0)

    def stage(self, name: str, note: str = "") -> None:
        """Announce a stage.

        Args:
            name, note: as in `Progress`.
        """
        self._tell(Step(name, note, 0, 0))

    def say(self, text: str) -> None:
        """Announce a message."""
        self.callback(Step(self.now.stage, text, 0, 0))

    def start(self, label: str, total: int) -> None:
        """Announce work that begins.

        Args:
            label, total: as in `Progress`.
        """
        self._tell(Step(self.now.stage, label, 0, total))

    def advance(self, steps: int = 1) -> None:
        """Count steps that are done."""
        self._tell(self.now._replace(done=self.now.done + steps))

    def _tell(self, step: Step) -> None:
        self.now = step
        self.callback(step)


def as_progress(shown: Progress | Callback | None) -> Progress:
    """Return the display of progress that a caller means.

    Args:
        shown: a display, a function that is called with every step, or None for silence.
    """
    if shown is None:
        return SilentProgress()
    return CallbackProgress(shown) if callable(shown) else shown


def track(progress: Progress, items: Iterable[Item], label: str, total: int) -> Iterator[Item]:
    """Yield the items and count each one when the caller is done with it.

    Args:
        progress: where they are counted.
        items: what is worked on, in order.
        label: what is done, for people.
        total: number of items.
    """
    progress.start(label, total)
    try:
        for item in items:
            yield item
            progress.advance()
    finally:
        progress.finish()
