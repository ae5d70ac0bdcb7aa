"""What a stage gets besides its inputs: settings, workers, progress, and a place to record its figures."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from sfm_app.files import save_files
from sfm_app.operating_system import machine_memory_mb
from sfm_app.plugins import Plugins
from sfm_app.progress import Progress, SilentProgress, track
from sfm_app.runtime.cost_estimate import SHARE_OF_MACHINE
from sfm_app.runtime.parallel import make_executor, ordered_map, threads_elsewhere
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.types import ControlPoints, GivenCameras, Model

# What a finished run of other photos in the same folder left behind, for stages that go on from it.


@dataclass(frozen=True, slots=True)
class Earlier:
    """Stages of an earlier run with the same settings and versions, whose photos partly are those of this run."""

    place: Workspace
    """Where their files were put; not to be changed."""
    stages: tuple[str, ...]
    """Names of the stages whose files are complete, in order."""
    fingerprint: str
    """Hash of what these stages were made from."""
    known: frozenset[str]
    """Names of the photos that are the same: in content, name, size, camera group and mask."""
    new: frozenset[str]
    """Names of photos that came, or that were replaced."""
    gone: frozenset[str]
    """Names of photos that were taken away, or replaced."""

    @property
    def text(self) -> str:
        """What changed, for people."""
        left = f", {len(self.gone - self.new)} left" if self.gone - self.new else ""
        return f"{len(self.known)} photos are known, {len(self.new)} are new{left}"

    def with_replaced(self, names: Collection[str]) -> "Earlier":
        """Return the same, with some known photos as replaced ones.

        Args:
            names: of photos whose features are not those that the earlier run found.
        """
        changed = self.known.intersection(names)
        return replace(self, known=self.known - changed, new=self.new | changed, gone=self.gone | changed)


def split_names(
    before: Mapping[str, str], now: Mapping[str, str]
) -> tuple[frozenset[str], frozenset[str], frozenset[str]]:
    """Return the names of photos that stayed the same, that are new, and that are gone; a replaced one is both.

    Args:
        before: hash of each photo of the earlier run, by name.
        now: those of this run.
    """
    known = frozenset(name for name, digest in now.items() if before.get(name) == digest)
    return known, frozenset(now) - known, frozenset(before) - known


Item = TypeVar("Item")
Result = TypeVar("Result")

STANDARD_FORMATS = ("ply", "glb")
"""Formats in which every run writes its models; `sfm-app export` writes others."""

GIVEN_CAMERAS, CONTROL_POINTS = "given_cameras", "control_points"
"""Names by which a stage says, among its settings, that it depends on what the calibration file, or the file of ground
control points, holds."""


@dataclass(frozen=True, slots=True)
class RunContext:
    """One run of the program, or one stage of it."""

    settings: Settings
    workspace: Workspace
    plugins: Plugins
    executor: Executor
    workers: int
    progress: Progress = field(default_factory=SilentProgress)
    fingerprint: str = ""
    """Hash of everything that the stage's result depends on."""
    given: GivenCameras = field(default_factory=GivenCameras)
    """Cameras that the user knows."""
    control_points: ControlPoints = field(default_factory=ControlPoints)
    """Ground control points that the user knows."""
    earlier: Earlier | None = None
    """What the stage may go on from: files of a run with other photos; None where everything is done afresh."""
    statistics: dict[str, Any] = field(default_factory=dict)
    """What the stage has counted so far, for the manifest; no part of a product is read from here."""

    def with_fingerprint(self, fingerprint: str) -> "RunContext":
        """Return the same run for a stage that has counted nothing yet."""
        return replace(self, fingerprint=fingerprint, statistics={})

    @property
    def seed(self) -> int:
        """The run's seed; parts derive theirs from it and from their own ids."""
        return self.settings.seed

    @property
    def spread(self) -> int:
        """How many tasks a cluster does at once; 0 where they stay in this process."""
        return threads_elsewhere(self.executor)

    @property
    def memory_mb(self) -> float:
        """Most memory in MB that the run may use."""
        return 1000 * self.settings.max_memory_gb or SHARE_OF_MACHINE * machine_memory_mb()

    @contextmanager
    def with_workers(self, workers: int) -> Iterator["RunContext"]:
        """Provide the same run with another number of workers, which stop when the block ends."""
        with make_executor(workers, like=self.executor) as executor:
            yield replace(self, workers=workers, executor=executor)

    @property
    def mask_dir(self) -> Path | None:
        """Folder of the laid-out masks of all photos; None where no masks are given."""
        return self.workspace.masks if self.settings.photos.masks else None

    def map(self, function: Callable[[Item], Result], items: Sequence[Item], label: str) -> list[Result]:
        """Return results in the order of the items, computed in parallel, with a progress bar.

        Args:
            function: applied to each item.
            items: its arguments.
            label: what is done, for people.
        """
        results = ordered_map(self.executor, function, items, ahead=2 * self.workers)
        return list(track(self.progress, results, label, len(items)))

    @contextmanager
    def step(self, label: str) -> Iterator[None]:
        """Show that a long piece of work without measurable progress is under way."""
        yield from track(self.progress, [None], label, 1)

    def record(self, **figures: Any) -> None:
        """Note figures of the stage for the manifest; plain numbers, strings, lists and dicts."""
        self.statistics.update(figures)

    def model_paths(self, name: str) -> tuple[Path, ...]:
        """Return the paths of a model of this name in the output folder."""
        return tuple(self.workspace.root / f"{name}.{suffix}" for suffix in STANDARD_FORMATS)

    def write_model(self, model: Model, name: str) -> tuple[Path, ...]:
        """Write a model into the output folder in every standard format and note how large the files are.

        Args:
            model: the finished model.
            name: of the files, without suffix.
        """
        paths = self.model_paths(name)
        for suffix in STANDARD_FORMATS:
            save_files(self.plugins.exporter(suffix).write(model, name), self.workspace.root)
        self.record(bytes={path.name: path.stat().st_size for path in paths})
        return paths
