"""The figure of a calibration: votes, lens and residuals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from sfm_app.camera.bearings import bearings, corner_angle, radius_deviation_px, radius_px
from sfm_app.errors import ConfigError
from sfm_app.estimation.calibrating import camera_pairs
from sfm_app.geometry.epipolar import FIRST, SECOND, fit_rays, gradients
from sfm_app.geometry.least_squares import inverse_of_positive
from sfm_app.report.text import center_text, focal_text, held_text, lens_text, verdict
from sfm_app.selfcal.consensus import Consensus
from sfm_app.selfcal.pairs import Pairs, prepare, undistort_pairs
from sfm_app.selfcal.thesis.curves import center_curves, focal_curves
from sfm_app.types import Calibration, CameraPairs, Intrinsics, MatchGraph, ViewGraph
from sfm_app.types.arrays import FloatArray
from sfm_app.types.camera import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE

# Residuals of matches over the photo, through the calibrated lens and before bundle adjustment.
#
# The signed Sampson distance of a match is linear in what its two pixels are off: d = a1 . v1 + a2 . v2, with a1
# and a2 the gradient of the epipolar constraint by the pixels of the two photos, of length 1 together. Where all
# photos share a camera, the part of v that does not depend on the match is what the lens model lacks. It is found
# for every cell of the photo, from all matches together. What moves the whole photo alike is not seen: relative
# poses absorb it.

RESIDUAL_CELLS = 14
"""Cells along the longer side of the photo. Chosen by hand."""
FEWEST = 12
"""Least number of keypoints in a cell that is shown. Chosen by hand."""
USUAL_PX, LEAST_NOISE_PX = 0.3, 0.02
"""Standard deviation of what a lens model lacks before the matches are seen, and the least noise of a distance. The
first keeps shifts and turns small that the relative poses absorb. Chosen by hand; not measured on their own."""
REFITS = 3
"""Fits of the epipolar geometry through a lens with distortion, with weights from the fit before. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class EpipolarResiduals:
    """Residuals of N matches of photos by one camera."""

    x: FloatArray
    """(2, N, 2) pixels in photo 1 and photo 2."""
    along: FloatArray
    """(2, N, 2) a1 and a2: how far the distance grows by each pixel coordinate."""
    distances_px: FloatArray
    """(N,) signed Sampson distances."""
    repeats: float = 1.0
    """In how many pairs a photo takes part: so often may the error of one keypoint count."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualGrid:
    """Residuals by cell of the photo, rows from the top."""

    shift_px: FloatArray
    """(R, C, 2) by how much keypoints lie off on average, right and down; NaN where there are few."""
    clear: NDArray[np.bool_]
    """(R, C) whether this exceeds two standard deviations."""
    size_px: FloatArray
    """(R, C) median absolute distance of the matches; NaN where there are few."""


def epipolar_residuals(pairs: CameraPairs, camera: Calibration) -> EpipolarResiduals:
    """Return the residuals of all inliers.

    Args:
        pairs: of this camera; their matrices are of pixels for a perspective camera, else of rays.
        camera: any projection.
    """
    x, along, distances = [np.zeros((2, 0, 2))], [np.zeros((2, 0, 2))], [np.zeros(0)]
    matched = ((F, np.asarray(x, np.float64)) for F, x in zip(pairs.Fs, pairs.inliers, strict=False) if len(x))
    for F, match in matched:
        points = match[:, :2], match[:, 2:]
        lines = np.hstack([bearings(one, camera) for one in points])
        E = _matrix_of_rays(F, lines, camera)
        length = gradients(E, lines)
        line2, line1 = lines[:, FIRST] @ E.T, lines[:, SECOND] @ E
        slopes1 = np.einsum("nki,ni->nk", lines[:, 3:9].reshape(-1, 2, 3), line1)
        slopes2 = np.einsum("nki,ni->nk", lines[:, 12:18].reshape(-1, 2, 3), line2)
        x.append(np.stack(points))
        along.append(np.stack([slopes1, slopes2]) / length[:, None])
        distances.append(np.einsum("ni,ni->n", lines[:, SECOND], line2) / length)
    photos = {photo for pair in pairs.photos for photo in pair}
    repeats = max(2.0 * len(pairs.photos) / len(photos), 1.0) if photos else 1.0
    return EpipolarResiduals(np.concatenate(x, 1), np.concatenate(along, 1), np.concatenate(distances), repeats)


def residual_grid(found: EpipolarResiduals, size: tuple[int, int]) -> ResidualGrid:
    """Return the residuals by cell.

    Args:
        found: the residuals.
        size: (width, height) of the photos in pixels.
    """
    side = max(size) / RESIDUAL_CELLS
    columns, rows = (max(1, round(length / side)) for length in size)
    count = rows * columns
    places = np.clip(found.x / np.array(size) * [columns, rows], 0, [columns - 1, rows - 1]).astype(np.int64)
    cells = places[..., 1] * columns + places[..., 0]
    many = np.bincount(cells.ravel(), minlength=count).reshape(rows, columns) >= FEWEST
    sizes = _medians(np.abs(found.distances_px), cells, count).reshape(rows, columns)
    shift, deviation = _mean_shifts(found, cells, count)
    shift, deviation = shift.reshape(rows, columns, 2), deviation.reshape(rows, columns, 2)
    clear = many & (np.hypot(*np.moveaxis(shift, 2, 0)) > 2.0 * np.hypot(*np.moveaxis(deviation, 2, 0)))
    return ResidualGrid(np.where(many[..., None], shift, np.nan), clear, np.where(many, sizes, np.nan))


def _mean_shifts(found: EpipolarResiduals, cells: NDArray[np.int64], count: int) -> tuple[FloatArray, FloatArray]:
    """Return shifts (count, 2) of keypoints by cell, by least squares over all matches, and their deviations."""
    matches = len(found.distances_px)
    spots = (2 * cells[..., None] + np.arange(2)).transpose(1, 0, 2).reshape(matches, 4)
    values = found.along.transpose(1, 0, 2).reshape(matches, 4)
    rows = np.repeat(np.arange(matches), 4)
    A = sparse.csr_array((values.ravel(), (rows, spots.ravel())), shape=(matches, 2 * count))
    noise = max(float(np.sqrt(found.repeats * np.mean(found.distances_px**2))) if matches else 0.0, LEAST_NOISE_PX)
    covariance = inverse_of_positive((A.T @ A).toarray() / noise**2 + np.eye(2 * count) / USUAL_PX**2)
    pull = np.asarray(A.T @ found.distances_px, np.float64) / noise**2
    shift = np.einsum("ij,j->i", covariance, pull)
    return shift.reshape(count, 2), np.sqrt(np.diag(covariance)).reshape(count, 2)


def _medians(values: FloatArray, cells: NDArray[np.int64], count: int) -> FloatArray:
    """Return (count,) medians of the values of matches by the cells of both keypoints; NaN without any."""
    found = np.full(count, np.nan)
    both = np.tile(values, 2)
    order = np.argsort(cells.ravel(), kind="stable")
    for cell, mine in zip(*_groups(cells.ravel()[order], both[order]), strict=True):
        found[cell] = np.median(mine)
    return found


def _groups(keys: NDArray[np.int64], values: FloatArray) -> tuple[list[int], list[FloatArray]]:
    """Return the distinct keys, which are sorted, and the values of each."""
    names, starts = np.unique(keys, return_index=True)
    return names.tolist(), np.split(values, starts[1:]) if len(names) else []


def _matrix_of_rays(F: FloatArray, lines: FloatArray, camera: Calibration) -> FloatArray:
    """Return the matrix (3, 3) of rays of a pair: the given one, or fitted again where the lens distorts."""
    if camera.projection != PERSPECTIVE:
        return F
    E = np.asarray(camera.K.T @ F @ camera.K, np.float64)
    for _ in range(REFITS if camera.is_bent else 0):
        E = fit_rays(lines[:, FIRST], lines[:, SECOND], gradients(E, lines) ** -2.0)
    return E


# Planes of two intrinsics: what every pair of photos votes for, and its zero curve (thesis Figure 5.13).
#
# Left: the plane of the two focals, with the optical center at its estimate. Right: the plane of the optical
# center, with the focals at their estimates. Many pairs agree where it is bright.

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

VOTE_CELLS = 160
"""Votes are counted on a grid of this many cells a side."""
CURVE_SAMPLES = 400
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
    _draw_curves(axes, plane, plane.extent, CURVE_SAMPLES)
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
    grid = [
        values.ravel()
        for values in np.meshgrid(_midpoints(left, right, VOTE_CELLS), _midpoints(bottom, top, VOTE_CELLS))
    ]
    fixed = {"fx": camera.K[0, 0], "fy": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2]}
    at = {name: np.full(VOTE_CELLS * VOTE_CELLS, value) for name, value in fixed.items()}
    at |= dict(zip(plane.names, grid, strict=True))
    unit = _unit(camera)
    focal, aspect = 0.5 * np.log(at["fx"] * at["fy"] / unit**2), np.log(at["fy"] / at["fx"])
    center = (at["cx"] - camera.width / 2) / unit, (at["cy"] - camera.height / 2) / unit
    thetas = np.column_stack([focal, *center, aspect])
    support = Consensus(pairs, np.inf).evaluate(thetas, SIGMA)
    return support.reshape(VOTE_CELLS, VOTE_CELLS) / max(float(np.sum(pairs.weights)), 1.0)


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


# Panels about the lens of a camera: its curve beside an ideal one, and the residuals over the photo.

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure


LENS_SAMPLES = 300
BAND = 2.0
"""Standard deviations on both sides of the curve that the band covers."""
ARROW = 0.9
"""Length of the longest arrow, in cells."""
LENS, IDEAL, QUIET = "#0077bb", "#444444", "#9a9a9a"


class LensCurve(NamedTuple):
    """A lens and the ideal one that it is compared with."""

    theta_deg: FloatArray
    """(N,) angles to the optical axis, up to the farthest corner."""
    radius_px: FloatArray
    """(N,)"""
    ideal_px: FloatArray
    """(N,)"""
    deviation_px: FloatArray
    """(N,) standard deviations of the radius."""
    ideal: str
    """What the ideal lens is called."""


def lens_curve(camera: Calibration) -> LensCurve:
    """Return the curve of a lens beside that of a pinhole, or of an equidistant fisheye, with the same focal.

    Args:
        camera: any projection.
    """
    panorama, fisheye = camera.projection == EQUIRECTANGULAR, camera.projection == FISHEYE
    theta = np.linspace(0.0, np.pi if panorama else corner_angle(camera), LENS_SAMPLES)
    radius = radius_px(theta, camera)
    ideal = radius if panorama else camera.focal_px * (theta if fisheye else np.tan(theta))
    name = "a whole turn" if panorama else "ideal equidistant lens" if fisheye else "ideal pinhole"
    return LensCurve(np.degrees(theta), radius, ideal, radius_deviation_px(theta, camera), name)


def draw_lens_panels(part: "SubFigure", camera: Calibration, pairs: CameraPairs) -> None:
    """Draw the curve of a lens, its distance from the ideal one, and the residuals over the photo.

    Args:
        part: of the figure.
        camera: any projection.
        pairs: of this camera.
    """
    grid = part.add_gridspec(2, 2, height_ratios=(3, 2), width_ratios=(1, 1.25))
    curve = lens_curve(camera)
    upper = part.add_subplot(grid[0, 0])
    _draw_curve(upper, curve, camera)
    _draw_difference(part.add_subplot(grid[1, 0], sharex=upper), curve)
    _draw_residuals(part, part.add_subplot(grid[:, 1]), camera, pairs)


def _draw_curve(axes: "Axes", curve: LensCurve, camera: Calibration) -> None:
    """Draw the radius over the angle, for a fisheye with the other textbook projections beside it."""
    theta = np.radians(curve.theta_deg)
    if camera.projection == FISHEYE:
        for name, style, radius in (
            ("stereographic", "-.", 2.0 * np.tan(theta / 2.0)),
            ("equisolid", ":", 2.0 * np.sin(theta / 2.0)),
        ):
            axes.plot(curve.theta_deg, camera.focal_px * radius, style, color=QUIET, linewidth=1.2, label=name)
    axes.plot(curve.theta_deg, curve.ideal_px, "--", color=IDEAL, linewidth=1.0, label=curve.ideal)
    axes.plot(curve.theta_deg, curve.radius_px, color=LENS, linewidth=2.0, label="this lens")
    axes.set(title="The lens: where it puts what is off its axis", ylabel="radius in the photo, px")
    axes.set(xlim=(0.0, float(curve.theta_deg[-1])), ylim=(0.0, None))
    axes.tick_params(labelbottom=False)
    axes.legend(loc="upper left", frameon=False)
    axes.grid(alpha=0.25)


def _draw_difference(axes: "Axes", curve: LensCurve) -> None:
    """Draw by how much the lens differs from the ideal one, with its band."""
    off = curve.radius_px - curve.ideal_px
    low, high = off - BAND * curve.deviation_px, off + BAND * curve.deviation_px
    axes.axhline(0.0, color=IDEAL, linestyle="--", linewidth=1.0)
    if curve.deviation_px.any():
        label = f"± {BAND:.0f} standard deviations"
        axes.fill_between(curve.theta_deg, low, high, color=LENS, alpha=0.3, linewidth=0.0, label=label)
        axes.legend(loc="best", frameon=False)
    axes.plot(curve.theta_deg, off, color=LENS, linewidth=1.5)
    axes.set(xlabel="angle to the optical axis, degrees", ylabel="minus the ideal, px")
    if not (np.nanmax(np.abs(off)) > 0.0 or curve.deviation_px.any()):
        axes.set_ylim(-1.0, 1.0)
    axes.grid(alpha=0.25)


def _draw_residuals(part: "SubFigure", axes: "Axes", camera: Calibration, pairs: CameraPairs) -> None:
    """Draw the size of the residuals as colors, and their mean by cell as arrows."""
    size = camera.width, camera.height
    extent = (0.0, float(size[0]), float(size[1]), 0.0)
    axes.set(xlim=extent[:2], ylim=extent[2:], aspect="equal", facecolor="#e8e8e8")
    axes.set(xlabel="across the photo, px", ylabel="down the photo, px")
    found = epipolar_residuals(pairs, camera)
    grid = residual_grid(found, size)
    if np.isnan(grid.size_px).all():
        axes.set_title("Residuals: no pair of photos is from this camera alone")
        return
    image = axes.imshow(grid.size_px, extent=extent, cmap="YlOrBr", vmin=0.0, interpolation="nearest", alpha=0.85)
    part.colorbar(image, ax=axes, label="median distance from the epipolar line, px", shrink=0.8)
    rows, columns = grid.size_px.shape
    x, y = np.meshgrid((np.arange(columns) + 0.5) * size[0] / columns, (np.arange(rows) + 0.5) * size[1] / rows)
    lengths = np.hypot(*np.moveaxis(grid.shift_px, 2, 0))
    longest = float(np.nanmax(lengths)) or 1.0
    scale = longest / (ARROW * size[0] / columns)
    for chosen, color in ((~grid.clear, QUIET), (grid.clear, "#111111")):
        u, v = (np.where(chosen, grid.shift_px[..., k], np.nan) for k in (0, 1))
        axes.quiver(x, y, u, v, angles="xy", scale_units="xy", scale=scale, color=color, width=0.0035, pivot="middle")
    axes.set_title(
        f"Residuals of {len(found.distances_px)} matches. Colors: their size. Arrows: what all have in common,\n"
        f"the longest is {longest:.2g} px; black ones are more than chance",
        fontsize=9.5,
    )


# The figure of a calibration: votes of the pairs, the curve of the lens, and the residuals over the photo.
#
# One block per camera. Perspective cameras have the planes of `vote_planes` above; below, and alone for fisheyes
# and panoramas, are the panels of `lens_panels`.

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
