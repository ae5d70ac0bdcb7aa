"""The context of a stage: settings, workers, progress, output folder, earlier run, statistics."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from sfm_app.files import save_files
from sfm_app.operating_system import machine_memory_mb
from sfm_app.plugins import Plugins
from sfm_app.progress import Progress, track
from sfm_app.runtime.cost_estimate import SHARE_OF_MACHINE
from sfm_app.runtime.parallel import make_executor, ordered_map, threads_elsewhere
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.types import ControlPoints, GivenCameras, Model


@dataclass(frozen=True, slots=True)
class Earlier:
    """Finished stages of an earlier run with the same settings and versions, and other photos."""

    place: Workspace
    """Folder of their files; read only."""
    stages: tuple[str, ...]
    """Names of the stages with complete files, in order."""
    fingerprint: str
    """Hash of the inputs of these stages."""
    known: frozenset[str]
    """Names of the unchanged photos: same content, name, size, camera group and mask."""
    new: frozenset[str]
    """Names of added or replaced photos."""
    gone: frozenset[str]
    """Names of removed or replaced photos."""

    @property
    def text(self) -> str:
        """The change of photos in words."""
        removed = f", {len(self.gone - self.new)} are gone" if self.gone - self.new else ""
        return f"{len(self.known)} photos are known, {len(self.new)} are new{removed}"

    def with_replaced(self, names: Collection[str]) -> "Earlier":
        """Return the same, with photos whose features differ from the earlier run's as replaced ones."""
        changed = self.known.intersection(names)
        return replace(self, known=self.known - changed, new=self.new | changed, gone=self.gone | changed)


def split_names(
    before: Mapping[str, str], now: Mapping[str, str]
) -> tuple[frozenset[str], frozenset[str], frozenset[str]]:
    """Return the names of known, new and gone photos from hashes by name; a replaced photo is new and gone."""
    known = frozenset(name for name, digest in now.items() if before.get(name) == digest)
    return known, frozenset(now) - known, frozenset(before) - known


Item = TypeVar("Item")
Result = TypeVar("Result")

STANDARD_FORMATS = ("ply", "glb")
"""Formats of the models of every run; `sfm-app export` writes others."""
GIVEN_CAMERAS, CONTROL_POINTS = "given_cameras", "control_points"
"""Entries of `Stage.settings` for the content of the calibration file, and of the file of ground control points."""


@dataclass(frozen=True, slots=True)
class RunContext:
    """One run of the program, or one stage of it."""

    settings: Settings
    workspace: Workspace
    plugins: Plugins
    executor: Executor
    workers: int
    progress: Progress = field(default_factory=Progress)
    fingerprint: str = ""
    given: GivenCameras = field(default_factory=GivenCameras)
    """Cameras from the user's calibration file."""
    control_points: ControlPoints = field(default_factory=ControlPoints)
    earlier: Earlier | None = None
    """Files of a run with other photos, from which the stage may resume."""
    statistics: dict[str, Any] = field(default_factory=dict)
    """Figures of the stage for the manifest; no part of a product is read from here."""

    def with_fingerprint(self, fingerprint: str) -> "RunContext":
        """Return the same run for another stage, without statistics."""
        return replace(self, fingerprint=fingerprint, statistics={})

    @property
    def seed(self) -> int:
        """The run's seed; parts derive their seeds from it and from their ids."""
        return self.settings.seed

    @property
    def spread(self) -> int:
        """Tasks at once on a cluster; 0 without a cluster."""
        return threads_elsewhere(self.executor)

    @property
    def memory_mb(self) -> float:
        """Most memory in MB that the run may use."""
        return 1000 * self.settings.max_memory_gb or SHARE_OF_MACHINE * machine_memory_mb()

    @contextmanager
    def with_workers(self, workers: int) -> Iterator["RunContext"]:
        """Provide the same run with other workers, which end with the block; an error in it cancels their tasks."""
        with make_executor(workers, like=self.executor) as executor:
            try:
                yield replace(self, workers=workers, executor=executor)
            except BaseException:
                executor.shutdown(wait=False, cancel_futures=True)
                raise

    @property
    def mask_dir(self) -> Path | None:
        """Folder of the masks that the photos are laid out with; None without masks."""
        return self.workspace.masks if self.workspace.masks.is_dir() else None

    def map(self, function: Callable[[Item], Result], items: Sequence[Item], label: str) -> list[Result]:
        """Return results in the order of the items, computed in parallel, with a progress bar of this label."""
        results = ordered_map(self.executor, function, items, ahead=2 * self.workers)
        return list(track(self.progress, results, label, len(items)))

    @contextmanager
    def step(self, label: str) -> Iterator[None]:
        """Show work without measurable progress."""
        yield from track(self.progress, [None], label, 1)

    def record(self, **figures: Any) -> None:
        """Add figures to the stage's statistics: plain numbers, strings, lists and dicts."""
        self.statistics.update(figures)

    def write_model(self, model: Model, name: str) -> tuple[Path, ...]:
        """Write a model in every standard format under this name, and record the sizes of the files."""
        written = (self.plugins.exporter(suffix).write(model, name) for suffix in STANDARD_FORMATS)
        paths = tuple(path for files in written for path in save_files(files, self.workspace.root))
        self.record(bytes={path.name: path.stat().st_size for path in paths})
        return paths
