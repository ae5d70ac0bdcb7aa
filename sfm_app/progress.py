"""The interface through which long work reports its progress, whatever displays it."""

from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

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
