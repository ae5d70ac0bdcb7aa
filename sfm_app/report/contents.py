"""Products in an output folder, read for the page; unfinished and damaged stages are left out."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

from sfm_app.errors import SfmError
from sfm_app.frame.scale import MetricFrame
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import PROBLEM
from sfm_app.stages import intrinsics, match_graph, photos, scale, scene, view_graph
from sfm_app.types import Intrinsics, MatchGraph, PhotoSet, Scene, ViewGraph

logger = logging.getLogger("sfm_app")

UNREADABLE = (SfmError, OSError, ArithmeticError, ValueError, LookupError, TypeError)
Product = TypeVar("Product")


class Problem(NamedTuple):
    """The error that ended a run."""

    message: str
    hint: str
    photos: Mapping[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class RunContents:
    """Products of the finished stages of a run."""

    run: RunContext
    manifest: Mapping[str, Any]
    photos: PhotoSet | None = None
    matches: MatchGraph | None = None
    views: ViewGraph | None = None
    intrinsics: Intrinsics | None = None
    scene: Scene | None = None
    frame: MetricFrame = field(default_factory=MetricFrame)
    """Frame of exported files; without a known scale, that of the scene."""

    @property
    def problem(self) -> "Problem | None":
        """The error that ended the last run; None if it finished."""
        entry = self.manifest.get(PROBLEM)
        if not entry:
            return None
        return Problem(entry.get("message", ""), entry.get("hint", ""), entry.get("photos", {}))

    @property
    def is_metric(self) -> bool:
        """Whether the unit of exported files is the meter."""
        by_gps = self.counts("scene").get("orientation", {}).get("unit") == "meter"
        return self.frame.is_metric or ("scale" not in self.stages and by_gps)

    @property
    def stages(self) -> Mapping[str, Any]:
        """Records of the finished stages, by name."""
        records: Mapping[str, Any] = self.manifest.get("stages", {})
        return records

    def counts(self, stage: str) -> Mapping[str, Any]:
        """Return the figures of a stage; empty if it has not run."""
        figures: Mapping[str, Any] = self.stages.get(stage, {}).get("counts", {})
        return figures


def read_contents(run: RunContext) -> RunContents:
    """Read the products of all finished stages."""
    manifest = run.workspace.manifest.read()
    listed = _read(run, manifest, photos, lambda: photos.read_photo_list(run.workspace))
    return RunContents(
        run,
        manifest,
        listed,
        _read(run, manifest, match_graph, lambda: match_graph.load(listed, run)) if listed is not None else None,
        _read(run, manifest, view_graph, lambda: view_graph.load(run)),
        _read(run, manifest, intrinsics, lambda: intrinsics.load(run)),
        _read(run, manifest, scene, lambda: scene.load(run)),
        _read(run, manifest, scale, lambda: scale.load(run)) or MetricFrame(),
    )


def read_scene(run: RunContext) -> RunContents:
    """Read the scene and its frame only: matches of many photos take long to read."""
    manifest = run.workspace.manifest.read()
    product = _read(run, manifest, scene, lambda: scene.load(run))
    frame = _read(run, manifest, scale, lambda: scale.load(run)) or MetricFrame()
    return RunContents(run, manifest, scene=product, frame=frame)


def _read(
    run: RunContext, manifest: Mapping[str, Any], module: ModuleType, load: Callable[[], Product | None]
) -> Product | None:
    stage, done = module.__name__.rpartition(".")[2], manifest.get("stages", {})
    if stage not in done:
        return None
    try:
        # checked before reading, because COLMAP never ends on some damaged models
        if done[stage]["digest"] != module.digest(run.workspace):
            raise ValueError(f"the files of stage {stage} have changed")
        return load()
    except UNREADABLE as err:  # the page shows the other stages
        logger.info("the report leaves out stage %s", stage, exc_info=err)
        return None
