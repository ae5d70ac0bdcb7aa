"""Data, shared experiments and the result folder for the figures of chapter 5."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.common.command_line import is_wanted
from benchmarks.common.figures import pyplot, save
from benchmarks.common.results import Row, write_csv
from benchmarks.thesis.chapter5.contests import Experiment, run_contest
from benchmarks.thesis.chapter5.sequences import CORNERS, ImageSequence, corner_sequence, photo_sequence
from benchmarks.thesis.claims import Claim


@dataclass(frozen=True, slots=True)
class FigureResult:
    """A finished figure or table."""

    claims: Sequence[Claim] = ()
    rows: Sequence[Row] = ()
    """For the JSON document."""
    note: str = ""
    """Note for the reader."""
    tables: str = ""
    """Markdown below the note."""


@dataclass(eq=False)
class Lab:
    """Options and shared results of one run of the benchmark."""

    data: Path
    cache: Path
    results: Path
    methods: Sequence[str]
    tests: int
    """Seeds per level of a figure."""
    runs: int
    """Seeds per sequence of the tables."""
    most: Mapping[str, int]
    """Limits of both for methods that take far longer than the others."""
    seed: int
    pool: Executor
    pictures: Sequence[str] | None = None
    """Figures to write: none if None, all if empty."""
    _sequences: dict[str, ImageSequence] = field(default_factory=dict)
    _contests: dict[str, list[Row]] = field(default_factory=dict)

    def sequence(self, name: str) -> ImageSequence:
        """Return a real sequence by the thesis's name."""
        if name not in self._sequences:
            found = corner_sequence(self.data, name) if name in CORNERS else photo_sequence(self.data, name, self.cache)
            self._sequences[name] = found
        return self._sequences[name]

    def run_contest(
        self,
        experiment: Callable[..., Any],
        sequence: str = "",
        tests: int | None = None,
        also: Mapping[str, str] | None = None,
    ) -> list[Row]:
        """Return the rows of an experiment of `setups`, run once; `also` maps more methods to one tested as often."""
        title = f"{experiment.__name__} {sequence}".strip()
        if title not in self._contests:
            count = self.tests if tests is None else tests
            each = {name: min(count, self.most.get(name, count)) for name in self.methods}
            each |= {name: each[like] for name, like in (also or {}).items() if like in each}
            bound: Experiment = partial(experiment, self.sequence(sequence)) if sequence else experiment
            self._contests[title] = run_contest(bound, each, self.seed, self.pool, title)
        return self._contests[title]

    @property
    def test_limits_text(self) -> str:
        """Methods that have fewer tests or runs, as text."""
        most = max(self.tests, self.runs)
        return (
            ", ".join(f"at most {count} of `{name}`" for name, count in self.most.items() if count < most) or "of all"
        )

    def keep(self, number: str, figure: Any, rows: Sequence[Row]) -> None:
        """Write the PNG and the CSV of a figure, if it was asked for."""
        if not is_wanted(self.pictures, number):
            pyplot().close(figure)
            return
        save(figure, self.results, f"chapter5-figure-{number}")
        if rows:
            write_csv(self.results, f"chapter5-figure-{number}", rows)
