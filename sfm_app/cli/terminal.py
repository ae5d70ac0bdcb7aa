"""Progress of a run on stderr: a line per stage, and a bar on a terminal."""

import os
import sys
import threading
import time
from collections.abc import Callable
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TaskID, TextColumn
from rich.progress import Progress as Bars
from rich.table import Column
from rich.text import Text

from sfm_app.cli.output import STAGE_TITLES, WIDTH, fold_lines, terminal_width, to_printable
from sfm_app.progress import Progress

LONG_STAGE_S, SILENCE_S, LINE_EVERY_S = 10.0, 5.0, 30.0
"""Seconds of a stage from which on its speed is printed; without a bar, seconds until the title of a stage is printed,
and seconds between two lines about its progress. Chosen by hand."""
CHECK_EVERY_S = 1.0
"""Seconds between two checks for these."""
MINUTE_S, FAST = 60.0, 10.0
LABEL_COLUMNS, BAR_COLUMNS, TITLE_COLUMNS = 32, 16, 38
"""Columns of a bar's label, of the bar, and of a stage's title in front of its seconds."""
INDENT = " " * 6


class Terminal(Progress):
    """Progress on stderr: a line per stage and a bar on a terminal, a few more lines elsewhere, nothing when quiet."""

    def __init__(
        self, *, quiet: bool, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.stream, self.clock = stream or sys.stderr, clock
        is_terminal, plain = self.stream.isatty(), "NO_COLOR" in os.environ
        self.console = Console(file=self.stream, quiet=quiet, highlight=False, force_terminal=is_terminal)
        self.dim = "" if plain else "dim"
        self.has_bar = is_terminal and not quiet and not self.console.is_dumb_terminal
        self.needs_lines = not quiet and not self.has_bar
        self.bars = Bars(
            TextColumn("  {task.description}", table_column=Column(width=LABEL_COLUMNS, no_wrap=True)),
            BarColumn(bar_width=BAR_COLUMNS),
            StateColumn(table_column=Column(no_wrap=True)),
            console=self.console,
            get_time=clock,
            transient=True,
            disable=not self.has_bar,
        )
        self.task: TaskID | None = None
        self.title, self.has_work = "", False
        """Title of the current stage, until it is printed; whether the bar shows some work of the stage."""
        self.is_open = False
        """Whether the last line is a title without a line break, for the seconds of the stage."""
        self.last_output_s = clock()
        self.closed, self.lock = threading.Event(), threading.RLock()

    def __enter__(self) -> "Terminal":
        if self.needs_lines:
            threading.Thread(target=self._watch_silence, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove the bar, end the line and stop the output."""
        with self.lock:
            self.closed.set()
            self._print_title()
            self._end_line()
            self._remove_bar()

    def stage(self, name: str, note: str = "") -> None:
        """Announce a stage; its title is printed once it ends or takes long, and is above the bar until then."""
        with self.lock:
            self._print_title()
            names = list(STAGE_TITLES)
            number = f"{names.index(name) + 1:2}/{len(names)} " if name in names else ""
            self.title = f"{number}{STAGE_TITLES.get(name, name)}{f' ({note})' if note else ''}"
            self.last_output_s = self.clock()
            self._show_bar(STAGE_TITLES.get(name, name), None)

    def finish_stage(self, seconds: float, photos: int = 0) -> None:
        """Print the duration of the stage; for a long stage with photos, also its speed."""
        with self.lock:
            rate = f", {per_minute(photos / seconds)} photos per minute" if photos and seconds >= LONG_STAGE_S else ""
            self._remove_bar()
            if self.title:
                self._print_title(end="")
            self._print("" if self.is_open else INDENT, f"{seconds:.1f} s{rate}", continues=self.is_open)

    def say(self, text: str) -> None:
        """Print a text below the title of its stage."""
        with self.lock:
            self._print_title()
            for line in fold_lines([f"{INDENT}{to_printable(text)}"], terminal_width(self.stream) or WIDTH):
                self._print(line)

    def start(self, label: str, total: int) -> None:
        """Show a bar for some work of `total` steps."""
        with self.lock:
            self.has_work = True
            self._show_bar(to_printable(label), total if total > 1 else None)  # a bar at 0/1 would stand still

    def advance(self, steps: int = 1) -> None:
        """Move the bar forward by some steps."""
        if self.task is not None and self.has_work:
            self.bars.advance(self.task, steps)

    def finish(self) -> None:
        """Show a bar without an end again: the stage continues."""
        with self.lock:
            if self.has_work:
                self.has_work = False
                self._show_bar("", None)

    def check_silence(self) -> None:
        """Print the title of the stage or the progress of its work after a silence."""
        silent_s = self.clock() - self.last_output_s
        if self.title and silent_s >= SILENCE_S:
            self._print_title(end="")
        elif self.bars.tasks and silent_s >= LINE_EVERY_S:
            task = self.bars.tasks[0]
            self._print(INDENT, f"{task.description}: {progress_text(task)}")

    def _watch_silence(self) -> None:
        while not self.closed.wait(CHECK_EVERY_S):
            with self.lock:
                self.check_silence()

    def _print_title(self, end: str = "\n") -> None:
        """Print the title of the stage unless it has been; without an end, its seconds may follow."""
        title, self.title = self.title, ""
        if title:
            self._print(title if end else f"{title:{TITLE_COLUMNS}} ", end=end)
            self.is_open = not end

    def _end_line(self) -> None:
        if self.is_open:
            self.is_open = False
            self.console.print()

    def _print(self, text: str, dim: str = "", *, end: str = "\n", continues: bool = False) -> None:
        if continues:
            self.is_open = False
        self._end_line()
        self.last_output_s = self.clock()
        self.console.print(Text.assemble(to_printable(text), (dim, self.dim)), soft_wrap=True, end=end)

    def _show_bar(self, label: str, total: int | None) -> None:
        """Show the bar with another label; an empty label keeps the present one."""
        if self.task is None:
            self.task = self.bars.add_task(label, total=total)
            self.bars.start()
        else:
            self.bars.reset(self.task, total=total, description=label or self.bars.tasks[0].description)

    def _remove_bar(self) -> None:
        if self.task is not None:
            self.bars.stop()
            self.bars.remove_task(self.task)
            self.task, self.has_work = None, False


class StateColumn(ProgressColumn):
    """Steps done, of all steps if their number is known, elapsed time and time left."""

    def render(self, task: Task) -> Text:
        """Return the text of a bar."""
        minutes, seconds = divmod(int(task.elapsed or 0.0), 60)
        remaining = remaining_text(task)
        time_text = f"{minutes}:{seconds:02}{f', {remaining}' if remaining else ''}"
        return Text.assemble(MofNCompleteColumn().render(task), f" {time_text}") if task.total else Text(time_text)


def progress_text(task: Task) -> str:
    """Return the steps done and the time left, or the elapsed time."""
    if not task.total:
        return f"{task.elapsed or 0.0:.0f} s so far"
    remaining = remaining_text(task)
    return f"{task.completed:.0f} of {task.total:.0f}{f', {remaining}' if remaining else ''}"


def remaining_text(task: Task) -> str:
    """Return the time left; empty before the first step."""
    if not task.elapsed or not task.completed or task.total is None:
        return ""
    seconds = (task.total - task.completed) * task.elapsed / task.completed
    return f"{seconds:.0f} s left" if seconds < MINUTE_S else f"{seconds / MINUTE_S:.0f} min left"


def per_minute(per_second: float) -> str:
    """Return a speed per minute, with one decimal below `FAST`."""
    speed = MINUTE_S * per_second
    return f"{speed:.0f}" if speed >= FAST else f"{speed:.1f}"
