"""Where the zero curves of all pairs meet, drawn: thesis Figure 5.13, with the votes behind the curves.

One row per camera. Left: the two focals, with the optical centre where it was found; right: the optical centre, with
the focals as found. Bright is where many pairs agree.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_app.errors import ConfigError
from sfm_app.report.words import centre_text, focal_text, held_text, lens_text, verdict
from sfm_app.selfcal.curves import centre_curves, focal_curves
from sfm_app.selfcal.inputs import FloatArray, Pairs, prepare
from sfm_app.selfcal.joint import Consensus
from sfm_app.stages.intrinsics import camera_pairs
from sfm_app.types import Calibration, CameraPairs, Intrinsics, MatchGraph, ViewGraph

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SUFFIXES = (".png", ".svg", ".pdf")
CELLS = 160
"""Votes are counted on a grid of this many cells a side."""
SAMPLES = 400
"""Samples along each curve: where a curve is steep, few leave it ragged."""
SIGMA = 0.05
"""Width of a vote, in units of r as in `Consensus`: the wider one of the search; the other hardly shows."""
FOCALS_SHOWN = (0.25, 2.2)
"""Range of the focals around the one found, as multiples of it."""
MOST_CAMERAS = 4
DEVIATIONS = 3.0
MARK, CURVE, GUIDE = "#00e5ff", "white", "#9a9a9a"


class Panel(NamedTuple):
    """One camera to draw."""

    name: str
    camera: Calibration
    pairs: CameraPairs


class Plane(NamedTuple):
    """Two of the parameters, in pixels; the others stay where they were found."""

    names: tuple[str, str]
    labels: tuple[str, str]
    extent: tuple[float, float, float, float]
    """Left, right, low, high."""
    found: tuple[float, float]


def check_figure(path: Path) -> None:
    """ConfigError unless the name ends as one of the formats that can be written."""
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"figure {path.name}: cannot write '{path.suffix}'", hint=f"use {', '.join(SUFFIXES)}")


def draw_intrinsics(path: Path, matches: MatchGraph, views: ViewGraph, found: Intrinsics) -> None:
    """`draw_calibration` of every camera of a run."""
    images = list(matches.images.values())
    draw_calibration(
        path,
        [
            Panel(name, camera, camera_pairs([image for image in images if image.group == name], matches, views))
            for name, camera in found.cameras.items()
        ],
    )


def draw_calibration(path: Path, panels: Sequence[Panel]) -> None:
    """Draw the votes and curves of every camera into a file; the same calibration gives the same bytes.

    Args:
        path: its suffix names the format, see `check_figure`; the folder is made where it is missing.
        panels: the first `MOST_CAMERAS` are drawn.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    check_figure(path)
    shown = panels[:MOST_CAMERAS]
    with rc_context({"font.size": 9, "svg.hashsalt": "sfm-app", "svg.fonttype": "none"}):
        figure = Figure(figsize=(11, 5.6 * len(shown)), layout="constrained")
        parts = figure.subfigures(len(shown), 1, squeeze=False)[:, 0]
        for part, panel in zip(parts, shown, strict=True):
            many = f"Camera {panel.name} ({len(panels)} in all). " if len(panels) > 1 else ""
            part.suptitle(many + in_words(panel.camera), fontsize=10, x=0.02, ha="left")
            left, right = part.subplots(1, 2)
            draw_camera(left, right, panel)
        path.parent.mkdir(parents=True, exist_ok=True)
        kind = path.suffix.lower()
        undated = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
        figure.savefig(path, dpi=130, metadata=undated[kind])


def in_words(camera: Calibration) -> str:
    """What was found, a line for each thing."""
    first = f"{focal_text(camera)} {verdict(camera)}"
    return "\n".join(filter(None, (first, centre_text(camera), lens_text(camera), held_text(camera))))


def draw_camera(left: "Axes", right: "Axes", panel: Panel) -> None:
    """Both planes of one camera."""
    camera = panel.camera
    unit, (u0, v0) = float(max(camera.width, camera.height)), (camera.width / 2, camera.height / 2)
    pairs = prepare(panel.pairs, unit_px=unit, origin_px=(u0, v0))
    (fx, _, cx), (_, fy, cy), _ = camera.K
    low, high = FOCALS_SHOWN
    focals = Plane(
        ("fx", "fy"),
        ("focal length across, px", "focal length down, px"),
        (low * fx, high * fx, low * fy, high * fy),
        (fx, fy),
    )
    centre = Plane(
        ("cx", "cy"),
        ("optical centre across the photo, px", "optical centre down the photo, px"),
        (0.0, float(camera.width), float(camera.height), 0.0),
        (cx, cy),
    )
    x = _steps(focals.extent[0], focals.extent[1], SAMPLES)
    draw_plane(
        left, focals, camera, pairs, (x, unit * focal_curves(pairs, x / unit, ((cx - u0) / unit, (cy - v0) / unit)))
    )
    x = _steps(centre.extent[0], centre.extent[1], SAMPLES)
    draw_plane(
        right, centre, camera, pairs, (x, unit * centre_curves(pairs, (x - u0) / unit, (fx / unit, fy / unit)) + v0)
    )
    left.axline((0.0, 0.0), slope=1.0, color=GUIDE, linewidth=0.8, linestyle=":")
    right.plot(u0, v0, "+", color=GUIDE, markersize=9)


def draw_plane(
    axes: "Axes", plane: Plane, camera: Calibration, pairs: Pairs, curves: tuple[FloatArray, FloatArray]
) -> None:
    """Votes, curves and K in one plane."""
    shades = votes(plane, camera, pairs)
    axes.imshow(shades, extent=plane.extent, origin="lower", aspect="auto", cmap="inferno", interpolation="bilinear")
    x, lines = curves
    axes.plot(x, _unbroken(lines, plane).T, color=CURVE, linewidth=0.6, alpha=_alpha(len(lines)))
    axes.plot(*plane.found, "o", markersize=13, markerfacecolor="none", markeredgecolor=MARK, markeredgewidth=1.6)
    axes.set(xlim=plane.extent[:2], ylim=plane.extent[2:], xlabel=plane.labels[0], ylabel=plane.labels[1])


def votes(plane: Plane, camera: Calibration, pairs: Pairs) -> FloatArray:
    """(CELLS, CELLS) share of the votes at every point of the plane, rows upwards as in `plane.extent`."""
    left, right, low, high = plane.extent
    x, y = np.meshgrid(_steps(left, right, CELLS), _steps(low, high, CELLS))
    K = {"fx": camera.K[0, 0], "fy": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2]}
    unit = float(max(camera.width, camera.height))
    at = {name: np.full(x.size, value) for name, value in K.items()} | dict(
        zip(plane.names, (x.ravel(), y.ravel()), strict=True)
    )
    thetas = np.column_stack(
        [
            np.log(np.sqrt(at["fx"] * at["fy"]) / unit),
            (at["cx"] - camera.width / 2) / unit,
            (at["cy"] - camera.height / 2) / unit,
            np.log(at["fy"] / at["fx"]),
        ]
    )
    support = Consensus(pairs, np.inf).at(thetas, SIGMA)
    return support.reshape(CELLS, CELLS) / max(float(np.sum(pairs.weights)), 1e-12)


def _steps(start: float, stop: float, count: int) -> FloatArray:
    return start + (stop - start) * (np.arange(count) + 0.5) / count


def _unbroken(curves: FloatArray, plane: Plane) -> FloatArray:
    """Curves without what lies outside of the plane, and without the jumps from one root to another."""
    low, high = sorted(plane.extent[2:])
    inside = np.where((curves > low) & (curves < high), curves, np.nan)
    jumps = np.abs(np.diff(inside, axis=1)) > 0.1 * (high - low)
    inside[:, 1:][jumps] = np.nan
    return inside


def _alpha(curves: int) -> float:
    return float(np.clip(12.0 / max(curves, 1), 0.15, 0.8))
