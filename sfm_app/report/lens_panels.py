"""Panels about the lens of a camera: its curve beside an ideal one, and the residuals over the photo."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.lenses.lens_curve import corner_angle, radius_deviation_px, radius_px
from sfm_app.report.residuals import epipolar_residuals, residual_grid
from sfm_app.types import Calibration, CameraPairs
from sfm_app.types.calibration import EQUIRECTANGULAR, FISHEYE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

FloatArray = NDArray[np.float64]

SAMPLES = 300
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
    theta = np.linspace(0.0, np.pi if panorama else corner_angle(camera), SAMPLES)
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
