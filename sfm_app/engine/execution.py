"""The loop that runs stages: what is up to date is skipped, what is damaged is done again, and all is written down."""

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import dropwhile

from sfm_app.colmap.backend import check_written
from sfm_app.engine.run_log import logged, peak_memory_mb
from sfm_app.engine.stage import Product, Products, Stage
from sfm_app.engine.staleness import OTHER_PHOTOS, fingerprint_of, made_with, manifest_head, why_again
from sfm_app.errors import BackendError, ConfigError, DamagedProductError, InputError
from sfm_app.photos import Source
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.cost_estimate import plan_within
from sfm_app.runtime.manifest import StageRecord
from sfm_app.types import PhotoSet

logger = logging.getLogger("sfm_app")


@dataclass(frozen=True, slots=True, eq=False)
class Pipeline:
    """Stages in order."""

    photos: Stage[PhotoSet]
    """The first stage, which takes what the user has given."""
    later: tuple[Stage[object], ...]

    @property
    def stages(self) -> tuple[Stage[object], ...]:
        """All of them."""
        return (self.photos, *self.later)

    @property
    def names(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(stage.name for stage in self.stages)

    def until(self, last: str) -> tuple[Stage[object], ...]:
        """Return the stages up to one, by its name."""
        return self.stages[: self.names.index(last) + 1]

    def run(
        self, source: Source, run: RunContext, first: str = "", last: str = "", wanted: Sequence[Stage[object]] = ()
    ) -> Products:
        """Run what is not up to date; stages whose files are damaged are done again, too.

        Args:
            source: what the user has given.
            run: the run.
            first: stage from which on everything is done again.
            last: stage to stop after; the last one where empty.
            wanted: stages whose products are read before it ends.

        Raises:
            SfmError: see errors.py; what was finished before stays valid.
        """
        for name in filter(None, (first, last)):
            if name not in self.names:
                raise ConfigError(f"no stage is named '{name}'", hint=f"stages: {', '.join(self.names)}")
        stages = self.until(last or self.names[-1])
        run.workspace.create()
        with run.workspace.held(), logged(run):
            run.workspace.manifest.check_format()
            for _ in self.stages:
                try:
                    return _Execution(self, source, run, first).through(stages, wanted)
                except DamagedProductError as err:
                    logger.info("%s", err, exc_info=err)
                    run.progress.stage(err.stage, "damaged: done again")
                    self.forget(err.stage, run)
                    first = ""
            return _Execution(self, source, run, first).through(stages, wanted)

    def forget(self, name: str, run: RunContext) -> None:
        """Take a stage out of the manifest, and those that build on its files; nobody builds on those of the photos.

        Args:
            name: of the stage.
            run: the run.
        """
        alone = name == self.photos.name
        run.workspace.manifest.forget((name,) if alone else self.names[self.names.index(name) :])


@dataclass(slots=True, eq=False)
class _Execution:
    """One way through the stages."""

    pipeline: Pipeline
    source: Source
    run: RunContext
    first: str
    """Stage from which on everything is done again; empty: none."""
    fingerprints: dict[str, str] = field(default_factory=dict)
    """By stage: hash of all that its result depends on, and what later stages depend on instead of it."""
    products: Products = field(init=False)

    def __post_init__(self) -> None:
        self.products = Products(self.run, self.source)

    def through(self, stages: Sequence[Stage[object]], wanted: Sequence[Stage[object]]) -> Products:
        """Run these stages where they are not up to date, and read the products that are wanted."""
        photos, later = self.pipeline.photos, stages[1:]
        again = self.why(photos, (self.source.fingerprint,))
        self.do(photos, again, self.run)
        # what else changed in the folder does not matter
        inputs = {photos.name: self.source.content(self.products[photos])}
        reasons: dict[str, str | None] = {}
        for stage in later:
            reasons[stage.name] = self.why(stage, [inputs[taken.name] for taken in stage.takes])
            inputs[stage.name] = self.fingerprints[stage.name]
        redone = photos.name if self.first == photos.name else ""
        ahead = list(dropwhile(lambda name: not redone and reasons[name] is None, reasons))
        with _planned(self.products[photos], ahead, self.run) as run:
            for stage in later:
                again = reasons[stage.name]
                self.do(stage, f"after {redone}" if redone and again in (None, OTHER_PHOTOS) else again, run)
                redone = redone if again is None else stage.name
        for stage in wanted:
            if stage in stages:
                self.products[stage]
        return self.products

    def why(self, stage: Stage[object], inputs: Sequence[str]) -> str | None:
        """Say why a stage is done again, as `why_again` does; keeps the fingerprint of what it depends on."""
        self.fingerprints[stage.name] = fingerprint_of(stage, inputs, self.run)
        again = why_again(stage, self.fingerprints[stage.name], self.run)
        return "as asked" if again is None and stage.name == self.first else again

    def do(self, stage: Stage[Product], again: str | None, run: RunContext) -> None:
        """Run a stage, unless there is no reason to (None), and enter it in the manifest."""
        if again is None:
            run.progress.stage(stage.name, "up to date")
            return
        self.pipeline.forget(stage.name, run)
        run.progress.stage(stage.name, f"again: {again}" if again else "")
        logger.info("%s begins%s", stage.name, f" again: {again}" if again else "")
        run = run.for_stage(self.fingerprints[stage.name])
        start = time.perf_counter()
        product = self.made(stage, run)
        seconds = round(time.perf_counter() - start, 2)
        place = run.workspace
        record = StageRecord(
            run.fingerprint, seconds, run.statistics, place.manifest.sizes(stage.files), peak_memory_mb(),
            made_with(stage, run), stage.digest(place),
        )  # fmt: skip
        place.manifest.finish(stage.name, record, manifest_head(run))
        logger.info("%s took %.2f s", stage.name, seconds)
        run.progress.stage_done(seconds)
        self.products.keep(stage, product)

    def made(self, stage: Stage[Product], run: RunContext) -> Product:
        """Return what a stage makes, if nothing from outside has disturbed it."""
        photos = self.pipeline.photos
        try:
            product = stage.make(self.products, run)
            used = product if isinstance(product, PhotoSet) else self.products[photos]
            disturbed(self.source, used, run)
        except Exception as err:
            logger.info("%s stopped: %s; counted so far: %s", stage.name, err, run.statistics)
            disturbed(self.source, None if stage is photos else self.products[photos], run, by=err)
            raise
        return product


@contextmanager
def _planned(photos: PhotoSet, ahead: Sequence[str], run: RunContext) -> Iterator[RunContext]:
    """Say what these stages will cost, and provide a run with as many workers as the memory allows.

    Raises:
        ConfigError: the photos need more than the user allows.
    """
    if not ahead:
        yield run
        return
    plan = plan_within(photos.photos, run.settings, run.workers, run.memory_mb, ahead)
    if run.settings.max_memory_gb and plan.peak_mb(ahead) > run.memory_mb:
        raise ConfigError(
            f"{plan.photos} photos need about {plan.peak_mb(ahead) / 1000:.1f} GB, more than --max-memory",
            hint="allow more, use fewer photos, or --quality draft",
        )
    run.progress.say(plan.text(ahead))
    logger.info("%s", plan.text(ahead))
    with run.with_workers(plan.workers) as narrower:
        yield narrower


def disturbed(source: Source, photos: PhotoSet | None, run: RunContext, by: Exception | None = None) -> None:
    """Check whether something from outside has disturbed a stage, and perhaps made it fail.

    Args:
        source: what the user has given.
        photos: that are used; None where nobody knows yet.
        run: the run.
        by: how the stage has failed, if it has.

    Raises:
        InputError: the output folder, or a photo, is not there any more, or is another one.
        OSError: the disk is full; COLMAP does not always say so.
    """
    run.workspace.check_there()
    try:
        if photos is not None:
            source.check(photos)
    except InputError as err:
        run.workspace.discard_unfinished()
        raise err from by
    if isinstance(by, BackendError):
        check_written(*(path for path in run.workspace.root.iterdir() if path.is_file()))
