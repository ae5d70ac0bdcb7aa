"""What the page of a run is served with. A request names a number, never a file, so it cannot name one outside OUT."""

import logging
import re
import shlex
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from threading import Lock

from sfm_app.numerical import Json
from sfm_app.report.page.contents import UNREADABLE, RunContents
from sfm_app.report.page.photo_rows import photo_names, picture
from sfm_app.report.page.scene_view import MOST_GLB_BYTES, light_model, model_file, view_frame, view_points
from sfm_app.report.page.writing import LargeParts, read_run, render_page
from sfm_app.report.view.levels import PointLevels, point_levels
from sfm_app.runtime.context import RunContext
from sfm_app.types import Model

logger = logging.getLogger("sfm_app")

SMALL_PX, LARGE_PX = 320, 2400
"""Longer sides of the pictures in the table, and of those that are asked for by a click."""
HTML, JPEG, GLB, BYTES = "text/html; charset=utf-8", "image/jpeg", "model/gltf-binary", "application/octet-stream"
NUMBERED = re.compile(r"/(pictures|photos|points)/([0-9]{1,9})")
"""Addresses of what there are many of."""


@dataclass(frozen=True, slots=True)
class Resource:
    """What a request is answered with."""

    kind: str
    """Its media type."""
    content: bytes | Path
    """A file is sent piece by piece."""


@dataclass
class RunResources:
    """The page of a run, and what it loads."""

    contents: RunContents
    names: list[str]
    """Names of the photos in order of the page's rows."""
    points: Model | None
    """Points and cameras; None where no photo has a place."""
    lock: Lock = field(default_factory=Lock)
    """Held while something is made that several requests may ask for."""

    @cached_property
    def page(self) -> bytes:
        """The page as HTML."""
        pictures = {name: f"pictures/{number}" for number, name in enumerate(self.names)}
        return render_page(self.contents, LargeParts(pictures, self._view(), is_served=True)).encode("utf-8")

    @cached_property
    def levels(self) -> PointLevels | None:
        """The points from coarse to fine."""
        return point_levels(self.points.surface) if self.points is not None else None

    @cached_property
    def light(self) -> bytes:
        """The model with smaller pages of texture."""
        return light_model(self.contents)

    def find(self, address: str) -> Resource | None:
        """Return what lies at an address of the page; None where there is nothing.

        Args:
            address: the path of a request, with or without a query.
        """
        path = address.partition("?")[0]
        if path == "/":
            return Resource(HTML, self.page)
        if path == "/model.glb":
            model = model_file(self.contents)
            return Resource(GLB, model) if model is not None else None
        if path == "/light.glb":
            return self._find_light()
        numbered = NUMBERED.fullmatch(path)
        return self._find_numbered(numbered[1], int(numbered[2])) if numbered else None

    def _find_light(self) -> Resource | None:
        """Return the lighter model where one is needed; None where it cannot be made, too."""
        if not self._is_large():
            return None
        try:
            with self.lock:
                return Resource(GLB, self.light)
        except UNREADABLE as err:  # the page goes on to the full model
            logger.info("there is no lighter model", exc_info=err)
            return None

    def _find_numbered(self, kind: str, number: int) -> Resource | None:
        if kind == "points":
            levels = self.levels
            return Resource(BYTES, levels.pack(number)) if levels and number < len(levels.counts) else None
        if number >= len(self.names):
            return None
        side = SMALL_PX if kind == "pictures" else LARGE_PX
        jpeg = picture(self.contents.run.workspace.photos / self.names[number], side)
        return Resource(JPEG, jpeg) if jpeg else None

    def _is_large(self) -> bool:
        """Return whether the model is so large that a lighter one is shown first."""
        model = model_file(self.contents)
        return model is not None and model.stat().st_size > MOST_GLB_BYTES

    def _view(self) -> dict[str, Json] | None:
        """Return what the 3D view needs, with addresses instead of data."""
        if self.points is None or self.levels is None:
            return None
        models = ["model.glb"] if model_file(self.contents) is not None else []
        large: dict[str, Json] = {
            "models": ["light.glb", *models] if self._is_large() else models,
            "levels": self.levels.counts,
            "photos": "photos",
            "out": shlex.quote(str(self.contents.run.workspace.root)),
        }
        return large | view_frame(self.contents, self.points, self.names)


def read_resources(run: RunContext) -> RunResources:
    """Return what the page of a run is served with, its page made.

    Args:
        run: with its output folder.

    Raises:
        InputError: the folder holds no run.
    """
    contents = read_run(run)
    found = RunResources(contents, photo_names(contents), view_points(contents))
    _ = found.page
    return found
