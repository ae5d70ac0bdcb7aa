"""The figure of a calibration: votes of the pairs, the curve of the lens, and the residuals over the photo.

Each camera has a block. Perspective cameras have two planes of votes above; below, or alone for fisheyes and panoramas,
are the panels of the lens.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_app.camera.bearings import bearings, corner_angle, radius_deviation_px, radius_px
from sfm_app.errors import ConfigError
from sfm_app.estimation.calibrating import photo_pairs
from sfm_app.geometry.epipolar import FIRST, SECOND, fit_rays, gradients, signed_distances
from sfm_app.report.text import camera_texts
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


class OPTIONS:
    """Sampling and sizes of the figure."""

    residual_cells: int = 14
    """Cells of residuals along the longer side of the photo. By hand."""
    least_keypoints: int = 12
    """Least number of keypoints in a cell that is drawn. By hand."""
    refits: int = 3
    """Fits of the epipolar geometry through a lens with distortion, each with weights of the last. By hand."""
    curve_samples: int = 400
    """Samples along each zero curve; with fewer, steep curves look ragged. By hand."""
    vote_sigma: float = 0.05
    """Width of a vote, in units of r as in `Consensus`: the wider one of the search. By hand."""
    bar_deviations: float = 3.0
    """Standard deviations on both sides of the estimate. By convention."""
    band_deviations: float = 2.0
    """Standard deviations on both sides of the lens curve. By convention."""
    most_cameras: int = 4
    """Cameras in the figure. By hand."""
    most_pairs: int = 300
    """Pairs of a camera in the figure, those of most weight: more lines hide each other and take a minute. By hand."""


# Residuals of matches over the photo, through the calibrated lens and before bundle adjustment. Where they are larger
# than elsewhere, the lens model errs.


def epipolar_residuals(pairs: CameraPairs, camera: Calibration) -> tuple[FloatArray, FloatArray]:
    """Return the pixels (2N, 2) of all inliers in both photos, and their Sampson distances (2N,) in pixels.

    Matrices of a perspective camera are of pixels, others of rays.
    """
    x, distances = [np.zeros((0, 2))], [np.zeros(0)]
    for F, match in zip(pairs.Fs, pairs.inliers, strict=False):
        if len(match):
            points = np.asarray(match, np.float64).reshape(-1, 2, 2).transpose(1, 0, 2)
            lines = np.hstack([bearings(one, camera) for one in points])
            x += [*points]
            distances += 2 * [np.abs(signed_distances(_matrix_of_rays(F, lines, camera), lines))]
    return np.concatenate(x), np.concatenate(distances)


def residual_grid(x: FloatArray, distances_px: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Return medians (R, C) of the distances (N,) at pixels (N, 2), by cell of photos of this size (width, height).

    Rows go down from the top; NaN for few keypoints.
    """
    from scipy.stats import binned_statistic_2d

    side = max(size) / OPTIONS.residual_cells
    edges = [np.linspace(0.0, length, max(1, round(length / side)) + 1) for length in size]
    medians = binned_statistic_2d(x[:, 0], x[:, 1], distances_px, "median", edges).statistic
    counts = np.histogram2d(x[:, 0], x[:, 1], edges)[0]
    return np.where(counts >= OPTIONS.least_keypoints, medians, np.nan).T


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
    left, right, bottom, top = plane.extent
    x = _midpoints(left, right, OPTIONS.curve_samples)
    y = _mask_jumps(plane.curves(x), min(bottom, top), max(bottom, top))
    # many curves are faint
    axes.plot(x, y.T, color=CURVE, linewidth=0.6, alpha=float(np.clip(12.0 / max(len(y), 1), 0.2, 0.8)))
    across, down = (OPTIONS.bar_deviations * deviation for deviation in plane.spread)
    marker, label = ("o", "estimate") if camera.identifiable else ("X", "a guess")
    label += f" ± {OPTIONS.bar_deviations:.0f} standard deviations" if min(plane.spread) > 0 else ""
    axes.errorbar(
        *plane.estimate, xerr=across, yerr=down, fmt=marker, markersize=12, fillstyle="none", color=MARK,
        markeredgewidth=1.6, label=label,
    )  # fmt: skip
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.set(title=plane.title, xlabel=plane.labels[0], ylabel=plane.labels[1])
    axes.legend(loc="lower right", labelcolor=CURVE, framealpha=0.6, facecolor="black", edgecolor="none")


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
    x, distances = epipolar_residuals(pairs, camera)
    if not len(x) or np.isnan(grid := residual_grid(x, distances, size)).all():
        axes.set_title("Residuals: no pair of photos is from this camera alone")
        return
    image = axes.imshow(grid, extent=extent, cmap="YlOrBr", vmin=0.0, interpolation="nearest")
    part.colorbar(image, ax=axes, label="median distance from the epipolar line, px", shrink=0.8)
    axes.set_title(f"Residuals of {len(x) // 2} matches")


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
            pairs = photo_pairs(own, matches, views, kind).to_camera_pairs([image.id for image in own])
            panels.append(Panel(name, camera, pairs))
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
            text = "\n".join(fill(line, 150) for line in camera_texts(panel.camera)).replace("+-", "±")
            count, most = len(panel.pairs.Fs), OPTIONS.most_pairs
            if count > most:
                text += f"\nThe figure shows the {most} pairs of most weight, of {count}."
            part.suptitle(many + text, fontsize=10.5, x=0.02, ha="left")
            _draw_camera(part, panel)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=130, metadata=SUFFIXES[path.suffix.lower()])


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
