"""The figure of a calibration: votes of the pairs, the curve of the lens, and the residuals over the photo.

One block per camera. Perspective cameras have the planes of `vote_planes` above; below, and alone for fisheyes and
panoramas, are the panels of `lens_panels`.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_app.errors import ConfigError
from sfm_app.estimation.calibrating import camera_pairs
from sfm_app.report.lens_panels import draw_lens_panels
from sfm_app.report.vote_planes import draw_vote_planes
from sfm_app.report.words import center_text, focal_text, held_text, lens_text, verdict
from sfm_app.types import Calibration, CameraPairs, Intrinsics, MatchGraph, ViewGraph
from sfm_app.types.calibration import PERSPECTIVE

if TYPE_CHECKING:
    from matplotlib.figure import SubFigure

SUFFIXES = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
"""Formats, and what is left out of the file so that the same figure gives the same bytes."""
MOST_CAMERAS = 4
MOST_PAIRS = 300
"""Pairs of a camera that are drawn, those of most weight: more lines hide each other, and take a minute."""
WIDTH_IN, TEXT_IN, PLANES_IN, LENS_IN = 12.5, 1.0, 4.6, 4.6
"""Size of the figure, and heights of the text, the planes and the panels of a camera, in inches."""


class Panel(NamedTuple):
    """One camera to draw."""

    name: str
    camera: Calibration
    pairs: CameraPairs

    @property
    def is_perspective(self) -> bool:
        """Whether its fundamental matrices are of pixels, so that zero curves exist."""
        return self.camera.projection == PERSPECTIVE

    @property
    def heights_in(self) -> tuple[float, ...]:
        """Heights of its rows in inches, the first with the text."""
        return (TEXT_IN + PLANES_IN, LENS_IN) if self.is_perspective else (TEXT_IN + LENS_IN,)


def check_figure(path: Path) -> None:
    """Raise ConfigError unless the suffix of the name is a supported format."""
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"figure {path.name}: cannot write '{path.suffix}'", hint=f"use {', '.join(SUFFIXES)}")


def draw_intrinsics(path: Path, matches: MatchGraph, views: ViewGraph, found: Intrinsics) -> None:
    """Draw the cameras of a run, those with most pairs of their own first.

    Args:
        path: as for `draw_calibration`.
        matches: the photos of the run.
        views: fundamental matrices of their pairs.
        found: the cameras.
    """
    images = list(matches.images.values())
    groups = {name: [image for image in images if found.camera_name(image) == name] for name in found.cameras}
    panels = [Panel(n, c, camera_pairs(groups[n], matches, views)) for n, c in found.cameras.items() if groups[n]]
    draw_calibration(path, sorted(panels, key=lambda panel: -len(panel.pairs.Fs)))


def draw_calibration(path: Path, panels: Sequence[Panel]) -> None:
    """Draw every camera into a file; the same calibration gives the same bytes.

    Args:
        path: its suffix names the format, see `check_figure`; the folder is created if it is missing.
        panels: the first `MOST_CAMERAS` are drawn.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    check_figure(path)
    shown = panels[:MOST_CAMERAS]
    heights = [sum(panel.heights_in) for panel in shown]
    with rc_context({"font.size": 9, "svg.hashsalt": "sfm-app"}):
        figure = Figure(figsize=(WIDTH_IN, sum(heights)), layout="constrained")
        parts = figure.subfigures(len(shown), 1, squeeze=False, height_ratios=heights)[:, 0]
        for part, panel in zip(parts, shown, strict=True):
            many = f"Camera {panel.name}, one of {len(panels)}.\n" if len(panels) > 1 else ""
            texts = filter(None, (calibration_text(panel.camera), pairs_text(len(panel.pairs.Fs))))
            part.suptitle(many + "\n".join(texts), fontsize=10.5, x=0.02, ha="left")
            _draw_camera(part, panel)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=130, metadata=SUFFIXES[path.suffix.lower()])


def calibration_text(camera: Calibration) -> str:
    """Return a calibration in words, one line per property."""
    texts = (verdict(camera), focal_text(camera), center_text(camera), lens_text(camera), held_text(camera))
    return "\n".join(fill(text, 150) for text in texts if text).replace("+-", "±")


def pairs_text(count: int) -> str:
    """Return how many pairs of a camera are drawn, of how many; empty where all are."""
    return f"Drawn are the {MOST_PAIRS} pairs of most weight, of {count}." if count > MOST_PAIRS else ""


def weightiest(pairs: CameraPairs, most: int) -> CameraPairs:
    """Return the pairs of most weight, in their order.

    Args:
        pairs: of one camera.
        most: of them that are kept.
    """
    kept = np.sort(np.argsort(-pairs.weights, kind="stable")[:most])
    return replace(
        pairs,
        Fs=pairs.Fs[kept],
        weights=pairs.weights[kept],
        photos=tuple(pairs.photos[k] for k in kept) if pairs.photos else (),
        inliers=tuple(pairs.inliers[k] for k in kept) if pairs.inliers else (),
    )


def _draw_camera(part: "SubFigure", panel: Panel) -> None:
    """Draw all rows of one camera."""
    panel = panel._replace(pairs=weightiest(panel.pairs, MOST_PAIRS))
    rows = part.subfigures(len(panel.heights_in), 1, squeeze=False, height_ratios=panel.heights_in)[:, 0]
    if panel.is_perspective:
        draw_vote_planes(rows[0], panel.camera, panel.pairs)
    draw_lens_panels(rows[-1], panel.camera, panel.pairs)
