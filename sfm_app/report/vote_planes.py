"""Planes of two intrinsics: what every pair of photos votes for, and its zero curve (thesis Figure 5.13).

Left: the plane of the two focals, with the optical center at its estimate. Right: the plane of the optical center, with
the focals at their estimates. Many pairs agree where it is bright.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_app.selfcal.consensus.consensus import Consensus
from sfm_app.selfcal.inputs import FloatArray, Pairs, prepare
from sfm_app.selfcal.thesis.curves import center_curves, focal_curves
from sfm_app.selfcal.undistort_pairs import undistort_pairs
from sfm_app.types import Calibration, CameraPairs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

CELLS = 160
"""Votes are counted on a grid of this many cells a side."""
SAMPLES = 400
"""Samples along each curve; with fewer, steep curves look ragged."""
ENLARGED_SAMPLES = 60
JUMP = 0.05
"""A curve that rises by this share of the plane from one sample to the next has changed to another root."""
SIGMA = 0.05
"""Width of a vote, in units of r as in `Consensus`: the wider one of the search; the narrower is hardly visible."""
FOCALS_SHOWN = (0.15, 2.2)
"""Range of the focals around the one found, as multiples of it."""
DEVIATIONS = 3.0
"""Standard deviations that the ellipse covers; in at most 1 % of cases the truth should lie outside."""
ZOOMED_BELOW = 0.1
"""An ellipse smaller than this share of the plane is drawn once more, enlarged."""
MARK, CURVE, GUIDE = "#00e5ff", "white", "#b0b0b0"


class ParameterPlane(NamedTuple):
    """Two of the parameters, in pixels; the others are fixed at their estimates."""

    names: tuple[str, str]
    title: str
    labels: tuple[str, str]
    extent: tuple[float, float, float, float]
    """Left, right, bottom, top."""
    found: tuple[float, float]
    spread: tuple[float, float]
    """Standard deviations; 0 where none is stated."""
    curves: Callable[[FloatArray], FloatArray]
    """(S,) first parameter -> (P, S) second, per pair."""


def draw_vote_planes(part: "SubFigure", camera: Calibration, own: CameraPairs) -> None:
    """Draw both planes of one perspective camera.

    Args:
        part: of the figure.
        camera: the calibration, in pixels.
        own: its pairs.
    """
    straight = undistort_pairs(own, camera)
    pairs = prepare(straight, unit_px=_unit(camera), origin_px=(camera.width / 2, camera.height / 2))
    left, right = part.subplots(1, 2)
    left.axline((0.0, 0.0), slope=1.0, color=GUIDE, linewidth=0.8, linestyle=":", label="square pixels")
    right.plot(camera.width / 2, camera.height / 2, "+", color=GUIDE, markersize=9, label="middle of the photo")
    for axes, plane in ((left, focal_plane(camera, pairs)), (right, center_plane(camera, pairs))):
        _draw_plane(axes, plane, camera, pairs)
    part.colorbar(right.images[0], ax=right, label="share of the pairs' votes", shrink=0.8)


def focal_plane(camera: Calibration, pairs: Pairs) -> ParameterPlane:
    """Return the plane of fx and fy, with the optical center at its estimate.

    Args:
        camera: the calibration, in pixels.
        pairs: of this camera, without lens distortion.
    """
    unit, (low, high) = _unit(camera), FOCALS_SHOWN
    (fx, _, cx), (_, fy, cy), _ = camera.K
    center = ((cx - camera.width / 2) / unit, (cy - camera.height / 2) / unit)
    return ParameterPlane(
        names=("fx", "fy"),
        title=f"Focal length: every line is what one of {len(pairs)} pairs of photos allows"
        if len(pairs)
        else "Focal length: no pair of photos is from this camera alone",
        labels=("focal length across, px", "focal length down, px"),
        extent=(low * fx, high * fx, low * fy, high * fy),
        found=(fx, fy),
        spread=(camera.spread.get("fx", 0.0), camera.spread.get("fy", 0.0)),
        curves=lambda x: unit * focal_curves(pairs, x / unit, center),
    )


def center_plane(camera: Calibration, pairs: Pairs) -> ParameterPlane:
    """Return the plane of cx and cy over the whole photo, with the focals at their estimates.

    Args:
        camera: the calibration, in pixels.
        pairs: of this camera, without lens distortion.
    """
    unit, u0, v0 = _unit(camera), camera.width / 2, camera.height / 2
    focals = (camera.K[0, 0] / unit, camera.K[1, 1] / unit)
    return ParameterPlane(
        names=("cx", "cy"),
        title="Optical center, in the frame of the photo",
        labels=("across the photo, px", "down the photo, px"),
        extent=(0.0, float(camera.width), float(camera.height), 0.0),
        found=(camera.K[0, 2], camera.K[1, 2]),
        spread=(camera.spread.get("cx", 0.0), camera.spread.get("cy", 0.0)),
        curves=lambda x: unit * center_curves(pairs, (x - u0) / unit, focals) + v0,
    )


def _draw_plane(axes: "Axes", plane: ParameterPlane, camera: Calibration, pairs: Pairs) -> None:
    """Draw votes, curves and K in one plane."""
    shades = vote_shares(plane, camera, pairs)
    axes.imshow(shades, extent=plane.extent, origin="lower", cmap="inferno", vmin=0, vmax=1, interpolation="bilinear")
    _draw_curves(axes, plane, plane.extent, SAMPLES)
    marker, label = ("o", "found") if camera.identifiable else ("X", "a guess")
    axes.plot(*plane.found, marker, markersize=12, fillstyle="none", color=MARK, markeredgewidth=1.6, label=label)
    axes.set(title=plane.title, xlabel=plane.labels[0], ylabel=plane.labels[1], aspect="equal")
    if camera.identifiable and min(plane.spread) > 0:
        _enlarge(axes, plane, camera)
    axes.legend(loc="lower right", labelcolor=CURVE, framealpha=0.6, facecolor="black", edgecolor="none")


def _draw_curves(axes: "Axes", plane: ParameterPlane, extent: tuple[float, float, float, float], samples: int) -> None:
    """Draw the part of all curves that is in `extent`; the more there are, the fainter."""
    left, right, bottom, top = extent
    x = _midpoints(left, right, samples)
    y = _mask_jumps(plane.curves(x), min(bottom, top), max(bottom, top))
    axes.plot(x, y.T, color=CURVE, linewidth=0.6, alpha=float(np.clip(12.0 / max(len(y), 1), 0.2, 0.8)))
    axes.set(xlim=(left, right), ylim=(bottom, top))


def _enlarge(axes: "Axes", plane: ParameterPlane, camera: Calibration) -> None:
    """Draw the ellipse in a window of its own where it would be too small to see."""
    from matplotlib.patches import Ellipse

    (x, y), (dx, dy) = plane.found, (DEVIATIONS * value for value in plane.spread)
    left, right, bottom, top = plane.extent
    target = axes
    if max(dx / abs(right - left), dy / abs(top - bottom)) < ZOOMED_BELOW:
        reach = 2.5 * max(dx, dy)
        window = (x - reach, x + reach, y - np.sign(top - bottom) * reach, y + np.sign(top - bottom) * reach)
        target = axes.inset_axes((0.63, 0.63, 0.35, 0.35))
        target.set_facecolor("#20123a")
        _draw_curves(target, plane, window, ENLARGED_SAMPLES)
        target.tick_params(colors=CURVE, labelsize=7)
        target.locator_params(nbins=3)
        axes.indicate_inset_zoom(target, edgecolor=GUIDE)
    label = f"{DEVIATIONS:.0f} standard deviations"
    if plane.names[0] == "fx" and ("aspect" in camera.held or camera.K[0, 0] == camera.K[1, 1]):
        # pixels are assumed square: fx and fy have the same error
        target.plot((x - dx, x + dx), (y - dy, y + dy), color=MARK, linewidth=1.8, label=label)
    else:
        target.add_patch(Ellipse((x, y), 2 * dx, 2 * dy, fill=False, edgecolor=MARK, linewidth=1.4, label=label))
    if target is not axes:
        axes.plot([], [], color=MARK, linewidth=1.6, label=f"{label} (enlarged)")


def vote_shares(plane: ParameterPlane, camera: Calibration, pairs: Pairs) -> FloatArray:
    """Return (CELLS, CELLS) share of the votes at every point of the plane; rows go from its bottom to its top.

    Args:
        plane: which two intrinsics vary.
        camera: the calibration, in pixels.
        pairs: of this camera, without lens distortion.
    """
    left, right, bottom, top = plane.extent
    grid = [values.ravel() for values in np.meshgrid(_midpoints(left, right, CELLS), _midpoints(bottom, top, CELLS))]
    fixed = {"fx": camera.K[0, 0], "fy": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2]}
    at = {name: np.full(CELLS * CELLS, value) for name, value in fixed.items()}
    at |= dict(zip(plane.names, grid, strict=True))
    unit = _unit(camera)
    focal, aspect = 0.5 * np.log(at["fx"] * at["fy"] / unit**2), np.log(at["fy"] / at["fx"])
    center = (at["cx"] - camera.width / 2) / unit, (at["cy"] - camera.height / 2) / unit
    thetas = np.column_stack([focal, *center, aspect])
    support = Consensus(pairs, np.inf).evaluate(thetas, SIGMA)
    return support.reshape(CELLS, CELLS) / max(float(np.sum(pairs.weights)), 1.0)


def _unit(camera: Calibration) -> float:
    return float(max(camera.width, camera.height))


def _midpoints(start: float, stop: float, count: int) -> FloatArray:
    return start + (stop - start) * (np.arange(count) + 0.5) / count


def _mask_jumps(curves: FloatArray, low: float, high: float) -> FloatArray:
    """Return the curves with NaN outside of the range and at jumps from one root to another."""
    inside = np.where((curves > low) & (curves < high), curves, np.nan)
    jumps = np.abs(np.diff(inside, axis=1)) > JUMP * (high - low)
    inside[:, 1:][jumps] = np.nan
    return inside
