"""The figure of a calibration: votes of the pairs, the curve of the lens, and the residuals over the photo.

Each camera has a block. Perspective cameras have two planes of votes above; below, or alone for fisheyes and panoramas,
are the panels of the lens.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.bearings import bearings, corner_angle, radius_deviation_px, radius_px
from sfm_app.errors import ConfigError
from sfm_app.estimation.calibrating import camera_pairs
from sfm_app.geometry.epipolar import FIRST, SECOND, fit_rays, gradients
from sfm_app.geometry.least_squares import inverse_of_positive
from sfm_app.report.text import center_text, focal_text, held_text, lens_text, verdict
from sfm_app.selfcal.calibrate_pairs import undistort_pairs
from sfm_app.selfcal.consensus import Consensus
from sfm_app.selfcal.pairs import Pairs, prepare
from sfm_app.selfcal.thesis.curves import center_curves, focal_curves
from sfm_app.types import Calibration, CameraPairs, EpipolarFit, Intrinsics, MatchGraph, RayFit, ViewGraph
from sfm_app.types.arrays import FloatArray
from sfm_app.types.camera import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure


@dataclass(frozen=True, slots=True)
class FigureOptions:
    """Sampling and sizes of the figure."""

    residual_cells: int = 14
    """Cells of residuals along the longer side of the photo. By hand."""
    least_keypoints: int = 12
    """Least number of keypoints in a cell that is drawn. By hand."""
    prior_px: float = 0.3
    """Prior standard deviation of an error of the lens model; it damps shifts that relative poses absorb. By hand."""
    least_noise_px: float = 0.02
    """Least standard deviation of a distance. By hand."""
    refits: int = 3
    """Fits of the epipolar geometry through a lens with distortion, each with weights of the last. By hand."""
    curve_samples: int = 400
    """Samples along each zero curve; with fewer, steep curves look ragged. By hand."""
    vote_sigma: float = 0.05
    """Width of a vote, in units of r as in `Consensus`: the wider one of the search. By hand."""
    ellipse_deviations: float = 3.0
    """Standard deviations of the ellipse: at most 1 % of true values lie outside. By convention."""
    band_deviations: float = 2.0
    """Standard deviations on both sides of the lens curve. By convention."""
    most_cameras: int = 4
    """Cameras in the figure. By hand."""
    most_pairs: int = 300
    """Pairs of a camera in the figure, those of most weight: more lines hide each other and take a minute. By hand."""


OPTIONS = FigureOptions()

# Residuals of matches over the photo, through the calibrated lens and before bundle adjustment.
# The signed Sampson distance of a match is linear in the errors of its two pixels: d = a1 . v1 + a2 . v2, with a1 and
# a2 the gradient of the epipolar constraint by the pixels of the two photos, of length 1 together. If all photos share
# a camera, the part of v that does not depend on the match is the error of the lens model. All matches together
# determine it for every cell of the photo, except for shifts of the whole photo, which relative poses absorb.


@dataclass(frozen=True, slots=True, eq=False)
class EpipolarResiduals:
    """Residuals of N matches of photos by one camera."""

    x: FloatArray
    """(2, N, 2) pixels in photo 1 and photo 2."""
    along: FloatArray
    """(2, N, 2) a1 and a2: gradient of the distance by each pixel coordinate."""
    distances_px: FloatArray
    """(N,) signed Sampson distances."""
    repeats: float = 1.0
    """Pairs per photo: so often may the error of one keypoint count."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualGrid:
    """Residuals by cell of the photo, rows from the top."""

    shift_px: FloatArray
    """(R, C, 2) mean error of keypoints, right and down; NaN for few keypoints."""
    clear: NDArray[np.bool_]
    """(R, C) whether it exceeds two standard deviations."""
    size_px: FloatArray
    """(R, C) median absolute distance of the matches; NaN for few keypoints."""


def epipolar_residuals(pairs: CameraPairs, camera: Calibration) -> EpipolarResiduals:
    """Return the residuals of all inliers; matrices of a perspective camera are of pixels, others of rays."""
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


def residual_grid(residuals: EpipolarResiduals, size: tuple[int, int]) -> ResidualGrid:
    """Return the residuals by cell of photos of this size (width, height) in pixels."""
    from scipy.stats import binned_statistic

    side = max(size) / OPTIONS.residual_cells
    columns, rows = (max(1, round(length / side)) for length in size)
    count = rows * columns
    places = np.clip(residuals.x / np.array(size) * [columns, rows], 0, [columns - 1, rows - 1]).astype(np.int64)
    cells = places[..., 1] * columns + places[..., 0]
    many = np.bincount(cells.ravel(), minlength=count).reshape(rows, columns) >= OPTIONS.least_keypoints
    both, edges = np.tile(np.abs(residuals.distances_px), 2), (-0.5, count - 0.5)
    sizes = binned_statistic(cells.ravel(), both, "median", count, edges).statistic.reshape(rows, columns)
    shift, deviation = _mean_shifts(residuals, cells, count)
    shift, deviation = shift.reshape(rows, columns, 2), deviation.reshape(rows, columns, 2)
    clear = many & (np.hypot(*np.moveaxis(shift, 2, 0)) > 2.0 * np.hypot(*np.moveaxis(deviation, 2, 0)))
    return ResidualGrid(np.where(many[..., None], shift, np.nan), clear, np.where(many, sizes, np.nan))


def _mean_shifts(residuals: EpipolarResiduals, cells: NDArray[np.int64], count: int) -> tuple[FloatArray, FloatArray]:
    """Return shifts (count, 2) of keypoints by cell, by least squares over all matches, and their deviations."""
    from scipy import sparse

    distances, matches = residuals.distances_px, len(residuals.distances_px)
    columns = (2 * cells[..., None] + np.arange(2)).transpose(1, 0, 2).reshape(matches, 4)
    values = residuals.along.transpose(1, 0, 2).reshape(matches, 4)
    rows = np.repeat(np.arange(matches), 4)
    A = sparse.csr_array((values.ravel(), (rows, columns.ravel())), shape=(matches, 2 * count))
    noise = max(float(np.sqrt(residuals.repeats * np.mean(distances**2))) if matches else 0.0, OPTIONS.least_noise_px)
    covariance = inverse_of_positive((A.T @ A).toarray() / noise**2 + np.eye(2 * count) / OPTIONS.prior_px**2)
    pull = np.asarray(A.T @ distances, np.float64) / noise**2
    shift = np.einsum("ij,j->i", covariance, pull)
    return shift.reshape(count, 2), np.sqrt(np.diag(covariance)).reshape(count, 2)


def _matrix_of_rays(F: FloatArray, lines: FloatArray, camera: Calibration) -> FloatArray:
    """Return the matrix (3, 3) of rays of a pair; a lens with distortion needs a new fit."""
    if camera.projection != PERSPECTIVE:
        return F
    E = np.asarray(camera.K.T @ F @ camera.K, np.float64)
    for _ in range(OPTIONS.refits if camera.is_bent else 0):
        E = fit_rays(lines[:, FIRST], lines[:, SECOND], gradients(E, lines) ** -2.0)
    return E


# Planes of two intrinsics: the votes of all pairs of photos, and their zero curves (thesis Figure 5.13).
# Left: the plane of the two focals, with the optical center at its estimate. Right: the plane of the optical
# center, with the focals at their estimates. Many pairs agree at bright places.

VOTE_CELLS = 160
"""Cells of the grid of votes a side. By hand."""
MARK, CURVE, GUIDE = "#00e5ff", "white", "#b0b0b0"


class ParameterPlane(NamedTuple):
    """Two of the parameters, in pixels; the others are fixed at their estimates."""

    names: tuple[str, str]
    title: str
    labels: tuple[str, str]
    extent: tuple[float, float, float, float]
    """Left, right, bottom, top."""
    estimate: tuple[float, float]
    spread: tuple[float, float]
    """Standard deviations; 0 if unknown."""
    curves: Callable[[FloatArray], FloatArray]
    """(S,) first parameter -> (P, S) second, per pair."""


def draw_vote_planes(part: "SubFigure", camera: Calibration, own: CameraPairs) -> None:
    """Draw both planes of a perspective camera from its own pairs."""
    straight = undistort_pairs(own, camera)
    pairs = prepare(straight, unit_px=_unit(camera), origin_px=(camera.width / 2, camera.height / 2))
    left, right = part.subplots(1, 2)
    left.axline((0.0, 0.0), slope=1.0, color=GUIDE, linewidth=0.8, linestyle=":", label="square pixels")
    right.plot(camera.width / 2, camera.height / 2, "+", color=GUIDE, markersize=9, label="middle of the photo")
    for axes, plane in ((left, focal_plane(camera, pairs)), (right, center_plane(camera, pairs))):
        _draw_plane(axes, plane, camera, pairs)
    part.colorbar(right.images[0], ax=right, label="share of the pairs' votes", shrink=0.8)


def focal_plane(camera: Calibration, pairs: Pairs) -> ParameterPlane:
    """Return the plane of fx and fy, with the optical center at its estimate; the pairs are undistorted."""
    unit, (low, high) = _unit(camera), (0.15, 2.2)
    (fx, _, cx), (_, fy, cy), _ = camera.K
    center = ((cx - camera.width / 2) / unit, (cy - camera.height / 2) / unit)
    return ParameterPlane(
        names=("fx", "fy"),
        title=f"Focal length: each line is the zero curve of one of {len(pairs)} pairs"
        if len(pairs)
        else "Focal length: no pair of photos is from this camera alone",
        labels=("focal length across, px", "focal length down, px"),
        extent=(low * fx, high * fx, low * fy, high * fy),
        estimate=(fx, fy),
        spread=(camera.spread.get("fx", 0.0), camera.spread.get("fy", 0.0)),
        curves=lambda x: unit * focal_curves(pairs, x / unit, center),
    )


def center_plane(camera: Calibration, pairs: Pairs) -> ParameterPlane:
    """Return the plane of cx and cy over the whole photo, with the focals at their estimates."""
    unit, u0, v0 = _unit(camera), camera.width / 2, camera.height / 2
    focals = (camera.K[0, 0] / unit, camera.K[1, 1] / unit)
    return ParameterPlane(
        names=("cx", "cy"),
        title="Optical center, in the frame of the photo",
        labels=("across the photo, px", "down the photo, px"),
        extent=(0.0, float(camera.width), float(camera.height), 0.0),
        estimate=(camera.K[0, 2], camera.K[1, 2]),
        spread=(camera.spread.get("cx", 0.0), camera.spread.get("cy", 0.0)),
        curves=lambda x: unit * center_curves(pairs, (x - u0) / unit, focals) + v0,
    )


def _draw_plane(axes: "Axes", plane: ParameterPlane, camera: Calibration, pairs: Pairs) -> None:
    shades = vote_shares(plane, camera, pairs)
    axes.imshow(shades, extent=plane.extent, origin="lower", cmap="inferno", vmin=0, vmax=1, interpolation="bilinear")
    _draw_curves(axes, plane, plane.extent, OPTIONS.curve_samples)
    marker, label = ("o", "estimate") if camera.identifiable else ("X", "a guess")
    axes.plot(*plane.estimate, marker, markersize=12, fillstyle="none", color=MARK, markeredgewidth=1.6, label=label)
    axes.set(title=plane.title, xlabel=plane.labels[0], ylabel=plane.labels[1], aspect="equal")
    if camera.identifiable and min(plane.spread) > 0:
        _enlarge(axes, plane, camera)
    axes.legend(loc="lower right", labelcolor=CURVE, framealpha=0.6, facecolor="black", edgecolor="none")


def _draw_curves(axes: "Axes", plane: ParameterPlane, extent: tuple[float, float, float, float], samples: int) -> None:
    """Draw the part of all curves within `extent`; many curves are faint."""
    left, right, bottom, top = extent
    x = _midpoints(left, right, samples)
    y = _mask_jumps(plane.curves(x), min(bottom, top), max(bottom, top))
    axes.plot(x, y.T, color=CURVE, linewidth=0.6, alpha=float(np.clip(12.0 / max(len(y), 1), 0.2, 0.8)))
    axes.set(xlim=(left, right), ylim=(bottom, top))


def _enlarge(axes: "Axes", plane: ParameterPlane, camera: Calibration) -> None:
    """Draw the ellipse of the deviations, enlarged in an inset if it is small."""
    from matplotlib.patches import Ellipse

    (x, y), (dx, dy) = plane.estimate, (OPTIONS.ellipse_deviations * value for value in plane.spread)
    left, right, bottom, top = plane.extent
    target = axes
    if max(dx / abs(right - left), dy / abs(top - bottom)) < 0.1:  # by hand
        reach = 2.5 * max(dx, dy)
        window = (x - reach, x + reach, y - np.sign(top - bottom) * reach, y + np.sign(top - bottom) * reach)
        target = axes.inset_axes((0.63, 0.63, 0.35, 0.35))
        target.set_facecolor("#20123a")
        _draw_curves(target, plane, window, 60)
        target.tick_params(colors=CURVE, labelsize=7)
        target.locator_params(nbins=3)
        axes.indicate_inset_zoom(target, edgecolor=GUIDE)
    label = f"{OPTIONS.ellipse_deviations:.0f} standard deviations"
    if plane.names[0] == "fx" and ("aspect" in camera.held or camera.K[0, 0] == camera.K[1, 1]):
        # pixels are assumed square: fx and fy have the same error
        target.plot((x - dx, x + dx), (y - dy, y + dy), color=MARK, linewidth=1.8, label=label)
    else:
        target.add_patch(Ellipse((x, y), 2 * dx, 2 * dy, fill=False, edgecolor=MARK, linewidth=1.4, label=label))
    if target is not axes:
        axes.plot([], [], color=MARK, linewidth=1.6, label=f"{label} (enlarged)")


def vote_shares(plane: ParameterPlane, camera: Calibration, pairs: Pairs) -> FloatArray:
    """Return (CELLS, CELLS) share of the votes at every point of the plane; rows go from its bottom to its top."""
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
    support = Consensus(pairs, np.inf).evaluate(thetas, OPTIONS.vote_sigma)
    return support.reshape(VOTE_CELLS, VOTE_CELLS) / max(float(np.sum(pairs.weights)), 1.0)


def _unit(camera: Calibration) -> float:
    return float(max(camera.width, camera.height))


def _midpoints(start: float, stop: float, count: int) -> FloatArray:
    return start + (stop - start) * (np.arange(count) + 0.5) / count


def _mask_jumps(curves: FloatArray, low: float, high: float) -> FloatArray:
    """Return the curves with NaN outside of the range and at jumps from one root to another."""
    inside = np.where((curves > low) & (curves < high), curves, np.nan)
    jumps = np.abs(np.diff(inside, axis=1)) > 0.05 * (high - low)  # by hand
    inside[:, 1:][jumps] = np.nan
    return inside


# Panels of the lens: its curve beside an ideal one, and the residuals over the photo.

LENS, IDEAL, QUIET = "#0077bb", "#444444", "#9a9a9a"


class LensCurve(NamedTuple):
    """A lens and an ideal one for comparison."""

    theta_deg: FloatArray
    radius_px: FloatArray
    ideal_px: FloatArray
    deviation_px: FloatArray
    """(N,) each: angles to the optical axis up to the farthest corner, radii, ideal radii, deviations of the radii."""
    ideal: str


def lens_curve(camera: Calibration) -> LensCurve:
    """Return the curve of a lens beside a pinhole, or an equidistant fisheye, of the same focal."""
    panorama, fisheye = camera.projection == EQUIRECTANGULAR, camera.projection == FISHEYE
    theta = np.linspace(0.0, np.pi if panorama else corner_angle(camera), 300)
    radius = radius_px(theta, camera)
    ideal = radius if panorama else camera.focal_px * (theta if fisheye else np.tan(theta))
    name = "equirectangular" if panorama else "ideal equidistant lens" if fisheye else "ideal pinhole"
    return LensCurve(np.degrees(theta), radius, ideal, radius_deviation_px(theta, camera), name)


def draw_lens_panels(part: "SubFigure", camera: Calibration, pairs: CameraPairs) -> None:
    """Draw the curve of a lens, its distance from the ideal lens, and the residuals over the photo."""
    grid = part.add_gridspec(2, 2, height_ratios=(3, 2), width_ratios=(1, 1.25))
    curve = lens_curve(camera)
    upper = part.add_subplot(grid[0, 0])
    _draw_curve(upper, curve, camera)
    _draw_difference(part.add_subplot(grid[1, 0], sharex=upper), curve)
    _draw_residuals(part, part.add_subplot(grid[:, 1]), camera, pairs)


def _draw_curve(axes: "Axes", curve: LensCurve, camera: Calibration) -> None:
    theta = np.radians(curve.theta_deg)
    if camera.projection == FISHEYE:
        for name, style, radius in (
            ("stereographic", "-.", 2.0 * np.tan(theta / 2.0)),
            ("equisolid", ":", 2.0 * np.sin(theta / 2.0)),
        ):
            axes.plot(curve.theta_deg, camera.focal_px * radius, style, color=QUIET, linewidth=1.2, label=name)
    axes.plot(curve.theta_deg, curve.ideal_px, "--", color=IDEAL, linewidth=1.0, label=curve.ideal)
    axes.plot(curve.theta_deg, curve.radius_px, color=LENS, linewidth=2.0, label="this lens")
    axes.set(title="The lens: image radius by angle", ylabel="radius in the photo, px")
    axes.set(xlim=(0.0, float(curve.theta_deg[-1])), ylim=(0.0, None))
    axes.tick_params(labelbottom=False)
    axes.legend(loc="upper left", frameon=False)
    axes.grid(alpha=0.25)


def _draw_difference(axes: "Axes", curve: LensCurve) -> None:
    off = curve.radius_px - curve.ideal_px
    band = OPTIONS.band_deviations * curve.deviation_px
    low, high = off - band, off + band
    axes.axhline(0.0, color=IDEAL, linestyle="--", linewidth=1.0)
    if curve.deviation_px.any():
        label = f"± {OPTIONS.band_deviations:.0f} standard deviations"
        axes.fill_between(curve.theta_deg, low, high, color=LENS, alpha=0.3, linewidth=0.0, label=label)
        axes.legend(loc="best", frameon=False)
    axes.plot(curve.theta_deg, off, color=LENS, linewidth=1.5)
    axes.set(xlabel="angle to the optical axis, degrees", ylabel="minus the ideal, px")
    if not (np.nanmax(np.abs(off)) > 0.0 or curve.deviation_px.any()):
        axes.set_ylim(-1.0, 1.0)
    axes.grid(alpha=0.25)


def _draw_residuals(part: "SubFigure", axes: "Axes", camera: Calibration, pairs: CameraPairs) -> None:
    size = camera.width, camera.height
    extent = (0.0, float(size[0]), float(size[1]), 0.0)
    axes.set(xlim=extent[:2], ylim=extent[2:], aspect="equal", facecolor="#e8e8e8")
    axes.set(xlabel="across the photo, px", ylabel="down the photo, px")
    residuals = epipolar_residuals(pairs, camera)
    grid = residual_grid(residuals, size)
    if np.isnan(grid.size_px).all():
        axes.set_title("Residuals: no pair of photos is from this camera alone")
        return
    image = axes.imshow(grid.size_px, extent=extent, cmap="YlOrBr", vmin=0.0, interpolation="nearest", alpha=0.85)
    part.colorbar(image, ax=axes, label="median distance from the epipolar line, px", shrink=0.8)
    rows, columns = grid.size_px.shape
    x, y = np.meshgrid((np.arange(columns) + 0.5) * size[0] / columns, (np.arange(rows) + 0.5) * size[1] / rows)
    lengths = np.hypot(*np.moveaxis(grid.shift_px, 2, 0))
    longest = float(np.nanmax(lengths)) or 1.0
    scale = longest / (0.9 * size[0] / columns)
    for chosen, color in ((~grid.clear, QUIET), (grid.clear, "#111111")):
        u, v = (np.where(chosen, grid.shift_px[..., k], np.nan) for k in (0, 1))
        axes.quiver(x, y, u, v, angles="xy", scale_units="xy", scale=scale, color=color, width=0.0035, pivot="middle")
    axes.set_title(
        f"Residuals of {len(residuals.distances_px)} matches. Colors: their size. Arrows: mean shift per cell,\n"
        f"the longest is {longest:.2g} px; black ones are significant",
        fontsize=9.5,
    )


# The whole figure.

SUFFIXES = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
"""Formats, and metadata that is omitted so that the same figure gives the same bytes."""
TEXT_IN, PANELS_IN = 1.0, 4.6
"""Heights of the text, and of a row of panels, in inches. By hand."""


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
        return (TEXT_IN + PANELS_IN, *([PANELS_IN] if self.is_perspective else []))


def check_figure(path: Path) -> None:
    """Raise ConfigError unless the suffix of the name is a supported format."""
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"figure {path.name}: cannot write '{path.suffix}'", hint=f"use {', '.join(SUFFIXES)}")


def draw_intrinsics(path: Path, matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics) -> None:
    """Draw the cameras of a run into a file, those with most pairs of their own first."""
    images = list(matches.images.values())
    panels = []
    for name, camera in intrinsics.cameras.items():
        if own := [image for image in images if intrinsics.camera_name(image) == name]:
            kind = EpipolarFit if camera.projection == PERSPECTIVE else RayFit
            panels.append(Panel(name, camera, camera_pairs(own, matches, views, kind)))
    draw_calibration(path, sorted(panels, key=lambda panel: -len(panel.pairs.Fs)))


def draw_calibration(path: Path, panels: Sequence[Panel]) -> None:
    """Draw at most `OPTIONS.most_cameras` cameras into a file; the same calibration gives the same bytes."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    check_figure(path)
    drawn = panels[: OPTIONS.most_cameras]
    heights = [sum(panel.heights_in) for panel in drawn]
    with rc_context({"font.size": 9, "svg.hashsalt": "sfm-app"}):
        figure = Figure(figsize=(12.5, sum(heights)), layout="constrained")
        parts = figure.subfigures(len(drawn), 1, squeeze=False, height_ratios=heights)[:, 0]
        for part, panel in zip(parts, drawn, strict=True):
            many = f"Camera {panel.name}, one of {len(panels)}.\n" if len(panels) > 1 else ""
            text, count, most = calibration_text(panel.camera), len(panel.pairs.Fs), OPTIONS.most_pairs
            if count > most:
                text += f"\nThe figure shows the {most} pairs of most weight, of {count}."
            part.suptitle(many + text, fontsize=10.5, x=0.02, ha="left")
            _draw_camera(part, panel)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=130, metadata=SUFFIXES[path.suffix.lower()])


def calibration_text(camera: Calibration) -> str:
    """Return a calibration in words, one line per property."""
    texts = (verdict(camera), focal_text(camera), center_text(camera), lens_text(camera), held_text(camera))
    return "\n".join(fill(text, 150) for text in texts if text).replace("+-", "±")


def weightiest(pairs: CameraPairs, most: int) -> CameraPairs:
    """Return the pairs of most weight, in their order."""
    chosen = np.sort(np.argsort(-pairs.weights, kind="stable")[:most])
    return replace(
        pairs,
        Fs=pairs.Fs[chosen],
        weights=pairs.weights[chosen],
        photos=tuple(pairs.photos[k] for k in chosen) if pairs.photos else (),
        inliers=tuple(pairs.inliers[k] for k in chosen) if pairs.inliers else (),
    )


def _draw_camera(part: "SubFigure", panel: Panel) -> None:
    panel = panel._replace(pairs=weightiest(panel.pairs, OPTIONS.most_pairs))
    rows = part.subfigures(len(panel.heights_in), 1, squeeze=False, height_ratios=panel.heights_in)[:, 0]
    if panel.is_perspective:
        draw_vote_planes(rows[0], panel.camera, panel.pairs)
    draw_lens_panels(rows[-1], panel.camera, panel.pairs)
