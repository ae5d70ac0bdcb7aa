"""The figures of the page, drawn while the surface is found: its helper processes leave cores idle."""

import logging
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from sfm_app.colmap.figures.observations import ModelFigures, model_figures
from sfm_app.report.page.contents import UNREADABLE, RunContents, read_contents
from sfm_app.report.page.page_figures import PageFigure, page_figures
from sfm_app.runtime.context import RunContext

logger = logging.getLogger("sfm_app")

IDLE = "mesh"
"""Stage that leaves cores idle, after all those that are drawn."""
MOST_PHOTOS = 100
"""Of a run whose figures are drawn early: the surface of more needs the memory. Chosen on castle-P19, where they take
280 MB."""
SHOWN = ("photos", "match_graph", "view_graph", "intrinsics", "scene")
"""Stages that are drawn."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnFigures:
    """What a page shows of the stages up to the scene."""

    model: ModelFigures | None
    """None where there is no model, or it cannot be read."""
    figures: Mapping[str, PageFigure]
    """By section of the page."""
    shown: tuple[str | None, ...]
    """Digests of the stages that they show."""

    @classmethod
    def draw(cls, contents: RunContents) -> "DrawnFigures":
        """Draw what a run has left."""
        model = _read_model(contents)
        return cls(model, page_figures(contents, model), _digests(contents))


class EarlyFigures:
    """Draws the figures of a run in a thread, as soon as there is time.

    Args:
        run: with its output folder.
    """

    def __init__(self, run: RunContext) -> None:
        self._run = run
        self._drawn: Future[DrawnFigures | None] | None = None

    def begin(self, stage: str) -> None:
        """Begin to draw, if the stage that begins leaves cores idle."""
        if stage != IDLE or not self._run.settings.report or self._drawn is not None:
            return
        thread = ThreadPoolExecutor(1, thread_name_prefix="figures")
        self._drawn = thread.submit(self._draw)
        thread.shutdown(wait=False)

    def _draw(self) -> DrawnFigures | None:
        photos = self._run.workspace.manifest.read()["stages"]["photos"]["counts"]["usable"]
        return DrawnFigures.draw(read_contents(self._run)) if photos <= MOST_PHOTOS else None

    def take(self, contents: RunContents) -> DrawnFigures | None:
        """Return the figures, if they were drawn and show what a run has left.

        Args:
            contents: what it has left.
        """
        if self._drawn is None or self._drawn.exception() is not None:
            return None
        found = self._drawn.result()
        return found if found is not None and found.shown == _digests(contents) else None


def _digests(contents: RunContents) -> tuple[str | None, ...]:
    return tuple(contents.stages.get(stage, {}).get("digest") for stage in SHOWN)


def _read_model(contents: RunContents) -> ModelFigures | None:
    if contents.scene is None:
        return None
    try:
        return model_figures(contents.scene.model_dir)
    except UNREADABLE as err:
        logger.info("the report has no figures of the model", exc_info=err)
        return None
