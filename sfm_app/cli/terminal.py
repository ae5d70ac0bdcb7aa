"""What a person sees of a run that goes on, on stderr."""

import os
import sys
import threading
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TaskID, TextColumn
from rich.progress import Progress as Bars
from rich.table import Column
from rich.text import Text

from sfm_app.cli.output import WIDTH, columns, fold_lines, to_printable
from sfm_app.cli.stage_titles import STAGE_TITLES

LONG_STAGE_S, SILENCE_S, LINE_EVERY_S = 10.0, 5.0, 30.0
"""Seconds of a stage whose speed is told; seconds of silence after which the stage is named where there is no bar, and
seconds between two lines on what it does then. Chosen by hand."""
LOOK_EVERY_S = 1.0
"""Seconds between two looks for silence."""
MINUTE_S, FAST = 60.0, 10.0
LABEL_COLUMNS, BAR_COLUMNS, TITLE_COLUMNS = 32, 16, 38
"""Of a bar's line, which has 80 at most, and of the title of a stage, with its seconds behind it."""
INDENT = " " * 6
"""Before what belongs to a stage."""


class Terminal:
    """Progress on stderr: a line per stage and a bar on a terminal, some lines more elsewhere, nothing when quiet.

    On a terminal something moves as long as a stage runs. Elsewhere, what takes long is named.
    """

    def __init__(self, *, quiet: bool) -> None:
        is_terminal, plain = sys.stderr.isatty(), "NO_COLOR" in os.environ
        self.console = Console(stderr=True, quiet=quiet, highlight=False, force_terminal=is_terminal)
        self.dim = "" if plain else "dim"
        self.has_bar = is_terminal and not quiet and not self.console.is_dumb_terminal
        self.bars = Bars(
            TextColumn("  {task.description}", table_column=Column(width=LABEL_COLUMNS, no_wrap=True)),
            BarColumn(bar_width=BAR_COLUMNS),
            StepsColumn(table_column=Column(no_wrap=True)),
            PaceColumn(table_column=Column(no_wrap=True)),
            console=self.console,
            transient=True,
            disable=not self.has_bar,
        )
        self.task: TaskID | None = None
        self.title, self.works = "", False
        """Of the current stage, while it is not printed yet; whether some work of it has started."""
        self.is_open = False
        """Whether the last line is a title that waits for its seconds."""
        self.said_s = time.monotonic()
        self.ended, self.lock = threading.Event(), threading.RLock()
        if not quiet and not self.has_bar:
            threading.Thread(target=self._look_for_silence, daemon=True).start()

    def __enter__(self) -> "Terminal":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Remove the bar and end the line; nothing is shown any more."""
        with self.lock:
            self.ended.set()
            self._print_title()
            self._end_line()
            self._remove_bar()

    def stage(self, name: str, note: str = "") -> None:
        """Announce a stage; its title is printed once it ends or takes long, and is above the bar until then.

        Args:
            name: of the stage.
            note: why it is skipped or done again; may be empty.
        """
        with self.lock:
            self._print_title()
            steps = list(STAGE_TITLES)
            number = f"{steps.index(name) + 1:2}/{len(steps)} " if name in steps else ""
            self.title = f"{number}{STAGE_TITLES.get(name, name)}{f' ({note})' if note else ''}"
            self.said_s = time.monotonic()
            self._show_bar(STAGE_TITLES.get(name, name), None)

    def finish_stage(self, seconds: float, photos: int = 0) -> None:
        """Print how long the stage took, and its speed where that is of interest.

        Args:
            seconds: its duration.
            photos: photos in use.
        """
        with self.lock:
            rate = f", {per_minute(photos / seconds)} photos per minute" if photos and seconds >= LONG_STAGE_S else ""
            self._remove_bar()
            if self.title:
                self._print_title(end="")
            self._print("" if self.is_open else INDENT, f"{seconds:.1f} s{rate}", goes_on=self.is_open)

    def say(self, text: str) -> None:
        """Print a text, below the title of the stage that it belongs to."""
        with self.lock:
            self._print_title()
            for line in fold_lines([f"{INDENT}{to_printable(text)}"], columns(sys.stderr) or WIDTH):
                self._print(line)

    def start(self, label: str, total: int) -> None:
        """Show a bar for work that begins.

        Args:
            label: what is done.
            total: steps of the work.
        """
        with self.lock:
            self.works = True
            self._show_bar(to_printable(label), total if total > 1 else None)  # nothing of "0/1" is news

    def advance(self, steps: int = 1) -> None:
        """Move the bar forward by some steps."""
        if self.task is not None and self.works:
            self.bars.advance(self.task, steps)

    def finish(self) -> None:
        """Show a bar without an end again, since the stage goes on."""
        with self.lock:
            if self.works:
                self.works = False
                self._show_bar("", None)

    def look(self) -> None:
        """Print a line where there has been none for long: the title, or how far the work is."""
        silent_s = time.monotonic() - self.said_s
        if self.title and silent_s >= SILENCE_S:
            self._print_title(end="")
        elif self.bars.tasks and silent_s >= LINE_EVERY_S:
            now = self.bars.tasks[0]
            self._print(INDENT, f"{now.description}: {progress_text(now)}")

    def _look_for_silence(self) -> None:
        while not self.ended.wait(LOOK_EVERY_S):
            with self.lock:
                self.look()

    def _print_title(self, end: str = "\n") -> None:
        """Print the title of the stage, if that has not been done; without an end, its seconds may follow."""
        title, self.title = self.title, ""
        if title:
            self._print(title if end else f"{title:{TITLE_COLUMNS}} ", end=end)
            self.is_open = not end

    def _end_line(self) -> None:
        if self.is_open:
            self.is_open = False
            self.console.print()

    def _print(self, text: str, dim: str = "", *, end: str = "\n", goes_on: bool = False) -> None:
        if goes_on:
            self.is_open = False
        self._end_line()
        self.said_s = time.monotonic()
        self.console.print(Text.assemble(to_printable(text), (dim, self.dim)), soft_wrap=True, end=end)

    def _show_bar(self, label: str, total: int | None) -> None:
        """Show the bar with another label; an empty one leaves it as it is."""
        if self.task is None:
            self.task = self.bars.add_task(label, total=total)
            self.bars.start()
        else:
            self.bars.reset(self.task, total=total, description=label or self.bars.tasks[0].description)

    def _remove_bar(self) -> None:
        if self.task is not None:
            self.bars.stop()
            self.bars.remove_task(self.task)
            self.task, self.works = None, False


class StepsColumn(ProgressColumn):
    """How many steps are done; empty where they are not known."""

    def render(self, task: Task) -> Text:
        """Return the text of a bar."""
        return MofNCompleteColumn().render(task) if task.total else Text("")


class PaceColumn(ProgressColumn):
    """The time that has passed and the time that is left."""

    def render(self, task: Task) -> Text:
        """Return the text of a bar."""
        minutes, seconds = divmod(int(task.elapsed or 0.0), 60)
        passed = f"{minutes}:{seconds:02}"
        left = left_text(task)
        return Text(f"{passed}, {left}" if left else passed)


def progress_text(task: Task) -> str:
    """Return how far some work is, and how fast it goes."""
    if not task.total:
        return f"goes on, {task.elapsed or 0.0:.0f} s so far"
    left = left_text(task)
    return f"{task.completed:.0f} of {task.total:.0f}{f', {left}' if left else ''}"


def left_text(task: Task) -> str:
    """Return the seconds or minutes that some work still takes; empty before it can be told."""
    if not task.elapsed or not task.completed or task.total is None:
        return ""
    left = (task.total - task.completed) * task.elapsed / task.completed
    return f"{left:.0f} s left" if left < MINUTE_S else f"{left / MINUTE_S:.0f} min left"


def per_minute(per_second: float) -> str:
    """Return a speed per minute, with two digits where it is small."""
    speed = MINUTE_S * per_second
    return f"{speed:.0f}" if speed >= FAST else f"{speed:.1f}"
