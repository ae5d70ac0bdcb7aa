"""What an output folder holds, read for the page; a stage that has not run, or whose files are damaged, is left out."""

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
"""What reading damaged files raises."""
Product = TypeVar("Product")


class Problem(NamedTuple):
    """What ended a run."""

    message: str
    hint: str
    photos: Mapping[str, str]
    """The photos concerned, each with its reason."""


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
    """That of exported files; that of the scene where nothing is known of its size."""

    @property
    def problem(self) -> "Problem | None":
        """What ended the last run; None where it went to its end."""
        noted = self.manifest.get(PROBLEM)
        if not noted:
            return None
        return Problem(noted.get("message", ""), noted.get("hint", ""), noted.get("photos", {}))

    @property
    def is_metric(self) -> bool:
        """Whether the unit of exported files is the meter."""
        by_gps = self.counts("scene").get("orientation", {}).get("unit") == "meter"
        return self.frame.is_metric or ("scale" not in self.stages and by_gps)

    @property
    def stages(self) -> Mapping[str, Any]:
        """Records of the finished stages, by name."""
        found: Mapping[str, Any] = self.manifest.get("stages", {})
        return found

    def counts(self, stage: str) -> Mapping[str, Any]:
        """Return the figures of a stage; empty where it has not run."""
        found: Mapping[str, Any] = self.stages.get(stage, {}).get("counts", {})
        return found


def read_contents(run: RunContext) -> RunContents:
    """Read what the finished stages of a run have left.

    Args:
        run: with its output folder.
    """
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
    """Read only what a picture of the model needs: matches of many photos take long to read.

    Args:
        run: with its output folder.
    """
    manifest = run.workspace.manifest.read()
    found = _read(run, manifest, scene, lambda: scene.load(run))
    frame = _read(run, manifest, scale, lambda: scale.load(run)) or MetricFrame()
    return RunContents(run, manifest, scene=found, frame=frame)


def _read(
    run: RunContext, manifest: Mapping[str, Any], module: ModuleType, load: Callable[[], Product | None]
) -> Product | None:
    """Return what a stage has left; None where it has not run, or its files are damaged."""
    stage, done = module.__name__.rpartition(".")[2], manifest.get("stages", {})
    if stage not in done:
        return None
    try:
        # compared before anything is read, because COLMAP never ends on some damaged models
        if done[stage]["digest"] != module.digest(run.workspace):
            raise ValueError(f"the files of stage {stage} have changed")
        return load()
    except UNREADABLE as err:  # the page shows what is left
        logger.info("the report leaves out stage %s", stage, exc_info=err)
        return None
