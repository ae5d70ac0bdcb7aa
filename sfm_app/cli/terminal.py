"""What a person sees of a run that goes on, on stderr."""

import time
from threading import Timer

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars
from rich.text import Text

STAGE_TITLES = {
    "photos": "reading photos",
    "match_graph": "finding and matching features",
    "view_graph": "fundamental matrices",
    "intrinsics": "camera matrix",
    "scene": "camera poses and points",
    "scale": "real size",
    "depth_maps": "depth maps",
    "mesh": "surface",
    "texture": "texture",
    "files": "files",
}

LONG_STAGE_S, LINE_EVERY_S = 10.0, 60.0
"""Seconds of a stage whose speed is told, and seconds between two lines on a long work where there is no bar."""
MINUTE_S, FAST = 60.0, 10.0


class Terminal:
    """Progress on stderr: bars on a terminal, some lines per stage otherwise, nothing when quiet."""

    def __init__(self, *, quiet: bool) -> None:
        self.console = Console(stderr=True, quiet=quiet, highlight=False)
        self.bars = Bars(
            TextColumn("  {task.description:18}"), BarColumn(bar_width=30), MofNCompleteColumn(), RateColumn(),
            TimeElapsedColumn(), console=self.console, transient=True, disable=quiet or not self.console.is_terminal,
        )  # fmt: skip
        self.task: TaskID | None = None
        self.said_s = 0.0
        self.reminder: Timer | None = None

    def stage(self, name: str, note: str = "") -> None:
        """Print the title of a stage.

        Args:
            name: of the stage.
            note: why it is skipped or done again; may be empty.
        """
        steps = list(STAGE_TITLES)
        number = f"{steps.index(name) + 1}/{len(steps)} " if name in steps else ""
        self.console.print(f"{number}{STAGE_TITLES.get(name, name)}{f' [dim]({escape(note)})[/dim]' if note else ''}")

    def finish_stage(self, seconds: float, photos: int = 0) -> None:
        """Print how long the stage took, and its speed where that is of interest.

        Args:
            seconds: its duration.
            photos: photos in use.
        """
        rate = f", {per_minute(photos / seconds)} photos per minute" if photos and seconds >= LONG_STAGE_S else ""
        self.console.print(f"    [dim]{seconds:.1f} s{rate}[/dim]")

    def say(self, text: str) -> None:
        """Print a text as it is."""
        self.console.print(escape(text))

    def start(self, label: str, total: int) -> None:
        """Show a bar for work that begins.

        Args:
            label: what is done.
            total: steps of the work.
        """
        self.task, self.said_s = self.bars.add_task(escape(label), total=total), time.monotonic()
        self.bars.start()
        if total == 1 and not self.console.is_terminal:  # it will not advance before its end
            self.reminder = Timer(LINE_EVERY_S, self.console.print, [f"    [dim]{escape(label)}[/dim]"])
            self.reminder.daemon = True
            self.reminder.start()

    def advance(self, steps: int = 1) -> None:
        """Move the bar forward by some steps; without a terminal, print a line from time to time."""
        if self.task is None:
            return
        self.bars.advance(self.task, steps)
        if self.reminder is None and not self.console.is_terminal and time.monotonic() - self.said_s >= LINE_EVERY_S:
            self.said_s = time.monotonic()
            now = next(task for task in self.bars.tasks if task.id == self.task)
            self.console.print(f"    [dim]{now.description} {progress_text(now)}[/dim]")

    def finish(self) -> None:
        """Remove the bar."""
        if self.reminder is not None:
            self.reminder.cancel()
            self.reminder = None
        if self.task is not None:
            self.bars.stop()
            self.bars.remove_task(self.task)
            self.task = None


class RateColumn(ProgressColumn):
    """Steps per minute, and the time that is left."""

    def render(self, task: Task) -> Text:
        """Return the text of a bar."""
        return Text(rate_text(task), style="dim")


def progress_text(task: Task) -> str:
    """Return how far some work is, and how fast it goes."""
    return f"{task.completed:.0f} of {task.total or 0:.0f}, {rate_text(task)}".rstrip(", ")


def rate_text(task: Task) -> str:
    """Return the mean speed of some work and the minutes that are left; empty before there is one."""
    if not task.elapsed or not task.completed or task.total is None:
        return ""
    speed = task.completed / task.elapsed
    left = (task.total - task.completed) / speed / MINUTE_S
    return f"{per_minute(speed)}/min, {f'{left:.0f} min' if left >= 1 else 'less than a minute'} left"


def per_minute(per_second: float) -> str:
    """Return a speed per minute, with two digits where it is small."""
    speed = MINUTE_S * per_second
    return f"{speed:.0f}" if speed >= FAST else f"{speed:.1f}"
