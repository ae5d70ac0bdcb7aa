"""Products in an output folder, read for the page; unfinished and damaged stages are left out."""

import base64
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

from sfm_app import products
from sfm_app.errors import SfmError
from sfm_app.frame.scale import MetricFrame
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import PROBLEM, Workspace
from sfm_app.types import Intrinsics, MatchGraph, PhotoSet, Scene, ViewGraph

logger = logging.getLogger("sfm_app")

UNREADABLE = (SfmError, OSError, ArithmeticError, ValueError, LookupError, TypeError)
Product = TypeVar("Product")


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
    def problem(self) -> Mapping[str, Any] | None:
        """Message, hint, and reason by photo of the error that ended the last run; None if it finished."""
        entry: Mapping[str, Any] | None = self.manifest.get(PROBLEM)
        return entry

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
    photos = _read(run, manifest, "photos", products.hash_photos, products.read_photo_list)
    matches = None
    if photos is not None:
        matches = _read(run, manifest, "match_graph", products.hash_matches, partial(products.read_matches, photos))
    return RunContents(
        run,
        manifest,
        photos,
        matches,
        _read(run, manifest, "view_graph", products.hash_view_graph, products.read_view_graph),
        _read(run, manifest, "intrinsics", products.hash_intrinsics, products.read_intrinsics),
        _read(run, manifest, "scene", products.hash_scene, products.read_scene),
        _read(run, manifest, "scale", products.hash_frame, products.read_frame) or MetricFrame(),
    )


def read_scene(run: RunContext) -> RunContents:
    """Read the scene and its frame only: matches of many photos take long to read."""
    manifest = run.workspace.manifest.read()
    scene = _read(run, manifest, "scene", products.hash_scene, products.read_scene)
    frame = _read(run, manifest, "scale", products.hash_frame, products.read_frame) or MetricFrame()
    return RunContents(run, manifest, scene=scene, frame=frame)


def _read(
    run: RunContext,
    manifest: Mapping[str, Any],
    stage: str,
    digest: Callable[[Workspace], str],
    read: Callable[[Workspace], Product],
) -> Product | None:
    done = manifest.get("stages", {})
    if stage not in done:
        return None
    try:
        # checked before reading, because COLMAP never ends on some damaged models
        if done[stage]["digest"] != digest(run.workspace):
            raise ValueError(f"the files of stage {stage} have changed")
        return read(run.workspace)
    except UNREADABLE as err:  # the page shows the other stages
        logger.info("the report leaves out stage %s", stage, exc_info=err)
        return None


def data_address(kind: str, data: bytes) -> str:
    """Return bytes as an address that a page holds itself; `kind` is their type, such as "image/png"."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
