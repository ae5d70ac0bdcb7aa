"""What a stage gets besides its inputs: workers, seed, progress, and a place to note what it counted."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any, TypeVar

from sfm_app.parallel import ordered_map
from sfm_app.plugins import Plugins
from sfm_app.progress import Progress, Silent, track
from sfm_app.settings import Settings
from sfm_app.workspace import Workspace

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(slots=True)
class RunContext:
    """One run of the program."""

    settings: Settings
    workspace: Workspace
    plugins: Plugins
    executor: Executor
    workers: int
    progress: Progress = field(default_factory=Silent)
    counts: dict[str, Any] = field(default_factory=dict)
    """What the current stage has counted so far."""

    @property
    def seed(self) -> int:
        """The run's seed; parts derive theirs from it and from their own ids."""
        return self.settings.seed

    def map(self, function: Callable[[Item], Result], items: Sequence[Item], label: str) -> list[Result]:
        """Results in the order of the items, computed in parallel, with a progress bar."""
        results = ordered_map(self.executor, function, items, ahead=2 * self.workers)
        return list(track(self.progress, results, label, len(items)))

    def record(self, **counts: Any) -> None:
        """Note figures of the current stage for the manifest; plain numbers, strings, lists and dicts."""
        self.counts |= counts
