"""How long work tells the outside where it stands, without knowing what shows it."""

from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

Item = TypeVar("Item")


class Progress(Protocol):
    """What a display of progress has to offer; the command line has one on stderr, a library call none."""

    def stage(self, name: str, note: str = "") -> None:
        """Announce a stage that begins (note empty), or was skipped, with the reason as note."""

    def stage_done(self, seconds: float) -> None:
        """Announce the end of the stage that began last, after so many seconds."""

    def say(self, text: str) -> None:
        """Say something that people should know before they wait."""

    def start(self, label: str, total: int) -> None:
        """Start work of `total` steps."""

    def advance(self, steps: int = 1) -> None:
        """Count so many more steps as done."""

    def finish(self) -> None:
        """Finish the work that was started last."""


class Silent:
    """Shows nothing."""

    def stage(self, name: str, note: str = "") -> None: ...

    def stage_done(self, seconds: float) -> None: ...

    def say(self, text: str) -> None: ...

    def start(self, label: str, total: int) -> None: ...

    def advance(self, steps: int = 1) -> None: ...

    def finish(self) -> None: ...


def track(progress: Progress, items: Iterable[Item], label: str, total: int) -> Iterator[Item]:
    """Yield the items and count each one once it has been dealt with."""
    progress.start(label, total)
    try:
        for item in items:
            yield item
            progress.advance()
    finally:
        progress.finish()
