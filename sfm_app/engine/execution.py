"""The loop that runs stages: it skips up-to-date ones, repeats damaged ones and records all."""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial

import psutil

from sfm_app.colmap.backend import check_written
from sfm_app.engine.incremental import find_earlier, forget_earlier, set_aside
from sfm_app.engine.stage import (
    PHOTOS_CHANGED,
    Product,
    Products,
    Stage,
    manifest_head,
    rerun_reason,
    settings_and_versions,
    stage_fingerprint,
)
from sfm_app.errors import BackendError, ConfigError, DamagedProductError, InputError
from sfm_app.files import fingerprint
from sfm_app.jit import warming_up
from sfm_app.operating_system import ChildTimes, cpu_seconds
from sfm_app.photos.source import Source
from sfm_app.progress import UP_TO_DATE
from sfm_app.runtime.context import Earlier, RunContext
from sfm_app.runtime.cost_estimate import choose_plan
from sfm_app.runtime.parallel import cpu_seconds_elsewhere
from sfm_app.runtime.workspace import StageRecord
from sfm_app.types import PhotoSet

logger = logging.getLogger("sfm_app")
LOGGERS = (logger, logging.getLogger("py.warnings"))


class LogFile(logging.FileHandler):
    """A log file that ignores write errors: the run itself reports a full disk."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Do nothing."""


@contextmanager
def log_to_file(run: RunContext) -> Iterator[None]:
    """Keep a log in the output folder, with the traceback of an error."""
    handler = LogFile(run.workspace.log, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    for each in LOGGERS:
        each.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    except BaseException:
        logger.exception("the run ended here")
        raise
    finally:
        for each in LOGGERS:
            each.removeHandler(handler)
        handler.close()


# Seconds, CPU seconds and memory of a stage, with the processes that it starts.


@dataclass(slots=True)
class Usage:
    """Cost of a piece of work; complete when it has ended."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """Of this process, its finished children, and the workers of a cluster."""
    peak_mb: int = 0
    """Peak resident memory; shared pages count for each process."""


@contextmanager
def measure_usage(elsewhere: Callable[[], float] = float, every_s: float = 0.5) -> Iterator[Usage]:
    """Measure the work within the block; `elsewhere` returns the CPU seconds of processes that are not its own."""
    used, ended, children = Usage(), threading.Event(), ChildTimes()
    start, cpu_start = time.perf_counter(), cpu_seconds() + elsewhere()

    def watch() -> None:
        while True:
            used.peak_mb = max(used.peak_mb, resident_mb(children))
            if ended.wait(every_s):
                return

    watcher = threading.Thread(target=watch, name="memory", daemon=True)
    watcher.start()
    try:
        yield used
    finally:
        ended.set()
        watcher.join()
        used.peak_mb = max(used.peak_mb, resident_mb(children))
        used.seconds = time.perf_counter() - start
        used.cpu_seconds = cpu_seconds() + children.seconds() + elsewhere() - cpu_start


def resident_mb(times: ChildTimes) -> int:
    """Return the memory of this process and of its children in MB, and record the time of the latter."""
    me = psutil.Process()
    command, total, children = me.cmdline(), int(me.memory_info().rss), me.children(recursive=True)
    times.look(children)
    for process in children:
        try:
            # a child that has not started its program yet shares our memory
            if process.cmdline() not in ([], command):
                total += process.memory_info().rss
        except psutil.Error:  # it has ended
            continue
    return round(total / 1e6)


@dataclass(frozen=True, slots=True, eq=False)
class Pipeline:
    """Stages in order."""

    photos: Stage[PhotoSet]
    """The first stage, which reads the user's photos or video."""
    later_stages: tuple[Stage[object], ...]

    @property
    def stages(self) -> tuple[Stage[object], ...]:
        """All stages, in order."""
        return (self.photos, *self.later_stages)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all stages."""
        return tuple(stage.name for stage in self.stages)

    def stages_until(self, last: str) -> tuple[Stage[object], ...]:
        """Return the stages up to and including this one."""
        return self.stages[: self.names.index(last) + 1]

    def run(
        self, source: Source, run: RunContext, first: str = "", last: str = "", targets: Sequence[Stage[object]] = ()
    ) -> Products:
        """Run the stages that are not up to date, and those with damaged files, up to `last`; from `first` on, all run.

        The products of `targets` are loaded before returning.
        """
        for name in filter(None, (first, last)):
            if name not in self.names:
                raise ConfigError(f"no stage is named '{name}'", hint=f"stages: {', '.join(self.names)}")
        stages = self.stages_until(last or self.names[-1])
        run.workspace.create()
        with run.workspace.hold_lock(), log_to_file(run):
            run.workspace.manifest.check_format()
            for _ in self.stages:
                try:
                    return _Execution(self, source, run, first).execute(stages, targets)
                except DamagedProductError as err:
                    logger.info("%s", err, exc_info=err)
                    run.progress.stage(err.stage, "damaged: running again")
                    self.forget(err.stage, run)
                    first = ""
            return _Execution(self, source, run, first).execute(stages, targets)

    def forget(self, name: str, run: RunContext) -> None:
        """Remove a stage and its dependents from the manifest; of the photos stage, none needs the files."""
        dependents = (stage.name for stage in self.stages if name in stage.depends_on and name != self.photos.name)
        run.workspace.manifest.forget((name, *dependents))


@dataclass(slots=True, eq=False)
class _Execution:
    pipeline: Pipeline
    source: Source
    run: RunContext
    first: str
    """Stage from which on all stages run again; empty for none."""
    fingerprints: dict[str, str] = field(default_factory=dict)
    """By stage: hash of everything that determines its result."""
    products: Products = field(init=False)
    earlier: Earlier | None = None
    """Run that stages may resume from."""

    def __post_init__(self) -> None:
        self.products = Products(self.run, self.source)

    def execute(self, stages: Sequence[Stage[object]], targets: Sequence[Stage[object]]) -> Products:
        """Run these stages unless they are up to date, and load the products of the `targets` ones."""
        photos, later = self.pipeline.photos, stages[1:]
        again = self.stage_rerun_reason(photos, (self.source.fingerprint,))
        self.run_stage(photos, again, self.run)
        # later stages do not depend on changes to other files in the folder
        inputs = {photos.name: self.source.content_hash(self.products[photos])}
        reasons: dict[str, str | None] = {}
        for stage in later:
            reasons[stage.name] = self.stage_rerun_reason(stage, [inputs[taken.name] for taken in stage.takes])
            inputs[stage.name] = self.fingerprints[stage.name]
        self.earlier = self.find_earlier(reasons)
        reasons = spread_reasons(later, reasons, (photos.name,) if self.first == photos.name else ())
        ahead = [name for name, again in reasons.items() if again is not None]
        with warming_up(self.run.progress.say) if ahead else nullcontext():
            run = _limit_workers(self.products[photos], ahead, self.run)
            for stage in later:
                self.run_stage(stage, reasons[stage.name], run)
                forget_earlier(run, if_finished=True)
        for stage in targets:
            if stage in stages:
                self.products[stage]
        return self.products

    def find_earlier(self, reasons: Mapping[str, str | None]) -> Earlier | None:
        """Return the earlier run to resume from; if only photos changed, its files are set aside first."""
        stages, photos = self.pipeline.later_stages, self.source.photo_hashes(self.products[self.pipeline.photos])
        redone = self.first in (self.pipeline.photos.name, stages[0].name)
        if reasons.get(stages[0].name) == PHOTOS_CHANGED and not redone:
            set_aside(stages, self.run)
        earlier = find_earlier(stages, photos, self.first, self.run)
        if earlier is not None and any(reasons.get(name) is not None for name in earlier.stages):
            self.run.progress.say(f"{earlier.text}; estimate for a full run:")
            logger.info("%s: stages %s resume from an earlier run", earlier.text, ", ".join(earlier.stages))
        return earlier

    def stage_rerun_reason(self, stage: Stage[object], inputs: Sequence[str]) -> str | None:
        """Return why a stage has to run, None if it is up to date; keep its fingerprint."""
        self.fingerprints[stage.name] = stage_fingerprint(stage, inputs, self.run)
        again = rerun_reason(stage, self.fingerprints[stage.name], self.run)
        return "as asked" if again is None and stage.name == self.first else again

    def run_stage(self, stage: Stage[Product], again: str | None, run: RunContext) -> None:
        """Run a stage and enter it in the manifest, unless it is up to date (`again` is None)."""
        if again is None:
            run.progress.stage(stage.name, UP_TO_DATE)
            return
        self.pipeline.forget(stage.name, run)
        run.progress.stage(stage.name, f"again: {again}" if again else "")
        logger.info("%s begins%s", stage.name, f" again: {again}" if again else "")
        inputs, earlier = self.fingerprints[stage.name], self.earlier
        if earlier is not None and stage.name in earlier.stages:
            run, inputs = replace(run, earlier=earlier), fingerprint(inputs, earlier.fingerprint)
        run = run.with_fingerprint(inputs)
        with measure_usage(partial(cpu_seconds_elsewhere, run.executor)) as used:
            product = self.make_product(stage, run)
        self.products.keep(stage, product)
        place, seconds = run.workspace, round(used.seconds, 2)
        first = stage is self.pipeline.later_stages[0]
        photos = self.source.photo_hashes(self.products[self.pipeline.photos]) if first else {}
        record = StageRecord(
            self.fingerprints[stage.name], seconds, run.statistics, place.manifest.sizes(stage.files), used.peak_mb,
            settings_and_versions(stage, run), stage.digest(place), round(used.cpu_seconds, 2), photos,
        )  # fmt: skip
        place.manifest.finish(stage.name, record, manifest_head(run))
        logger.info("%s took %.2f s, %.2f s of CPU and %d MB", stage.name, seconds, used.cpu_seconds, used.peak_mb)
        run.progress.finish_stage(seconds, len(self.products[self.pipeline.photos].photos))

    def make_product(self, stage: Stage[Product], run: RunContext) -> Product:
        """Return the product of a stage, after checking that photos and output folder did not change."""
        photos = self.pipeline.photos
        try:
            with run.with_workers(run.workers) as own:
                product = stage.make(self.products, own)
            used = product if isinstance(product, PhotoSet) else self.products[photos]
            check_undisturbed(self.source, used, run)
        except Exception as err:
            logger.info("%s stopped: %s; counted so far: %s", stage.name, err, run.statistics)
            check_undisturbed(self.source, None if stage is photos else self.products[photos], run, by=err)
            raise
        return product


def spread_reasons(
    stages: Sequence[Stage[object]], reasons: Mapping[str, str | None], redone: Sequence[str] = ()
) -> dict[str, str | None]:
    """Return why each stage runs again, with the stages that depend on them; `redone` ones are before all."""
    spread: dict[str, str | None] = {}
    for stage in stages:
        again, before = reasons[stage.name], [*redone, *(name for name, reason in spread.items() if reason is not None)]
        causes = [name for name in before if name in stage.depends_on]
        spread[stage.name] = f"after {causes[-1]}" if causes and again in (None, PHOTOS_CHANGED) else again
    return spread


def _limit_workers(photos: PhotoSet, ahead: Sequence[str], run: RunContext) -> RunContext:
    """Announce the cost of stages; return the run with as many workers as the memory allows, ConfigError for none."""
    if not ahead:
        return run
    plan = choose_plan(photos.photos, run.settings, run.workers, run.memory_mb, ahead)
    if run.settings.max_memory_gb and plan.peak_mb(ahead) > run.memory_mb:
        raise ConfigError(
            f"{plan.photos} photos need about {plan.peak_mb(ahead) / 1000:.1f} GB, more than --max-memory",
            hint="allow more, use fewer photos, or --quality draft",
        )
    run.progress.say(plan.text(ahead))
    logger.info("%s", plan.text(ahead))
    return replace(run, workers=plan.workers)


def check_undisturbed(source: Source, photos: PhotoSet | None, run: RunContext, by: Exception | None = None) -> None:
    """Raise an InputError if photos or output folder changed during a stage, an OSError if the disk is full."""
    run.workspace.check_exists()
    try:
        if photos is not None:
            source.check(photos)
    except InputError as err:
        run.workspace.discard_unfinished()
        raise err from by
    if isinstance(by, BackendError):
        check_written(*(path for path in run.workspace.root.iterdir() if path.is_file()))
