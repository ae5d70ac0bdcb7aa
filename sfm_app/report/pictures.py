"""Pictures of the report: figures and depth maps."""

import io
import logging
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from sfm_app.colmap.dense import read_photo_and_depth
from sfm_app.colmap.model import ModelFigures
from sfm_app.report.contents import UNREADABLE, RunContents, data_address
from sfm_app.report.figures import OPTIONS, draw_intrinsics
from sfm_app.stereo import Kind
from sfm_app.types.arrays import ByteArray, FloatArray
from sfm_app.types.scene import camera_center

# Figures: cameras, matched pairs of photos, and the scene from above.

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


logger = logging.getLogger("sfm_app")

LONGEST_TRACK = 12
"""Photos of a track; longer tracks share the last color. By hand."""
INK, ACCENT, BAD = "#444444", "#c2410c", "#b91c1c"


@dataclass(frozen=True, slots=True)
class PageFigure:
    """A picture of the page."""

    title: str
    text: str
    """Caption, and text for screen readers."""
    address: str
    """Its bytes as a data address."""


def page_figures(contents: RunContents, figures: ModelFigures | None) -> dict[str, PageFigure]:
    """Return the figures that can be drawn, by section of the page."""
    sections: Mapping[str, Callable[[], PageFigure | None]] = {
        "cameras": lambda: _draw_cameras(contents),
        "pairs": lambda: _draw_pairs(contents),
        "above": lambda: _draw_above(contents, figures),
    }
    drawn = {}
    for name, draw in sections.items():
        try:
            figure = draw()
        except UNREADABLE as err:  # the page has the others
            logger.info("the report has no figure of %s", name, exc_info=err)
            continue
        if figure is not None:
            drawn[name] = figure
    return drawn


def _draw_cameras(contents: RunContents) -> PageFigure | None:
    matches, views, intrinsics = contents.matches, contents.views, contents.intrinsics
    if matches is None or views is None or intrinsics is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cameras.png"
        draw_intrinsics(path, matches, views, intrinsics)
        data = path.read_bytes()
    text = (
        "Above: the votes of all pairs of photos in the planes of the focal lengths and of the optical center, with "
        "the zero curves of the best pairs; many pairs agree at bright places. Below: the lens beside an ideal one, "
        "and the residuals over the photo."
    )
    count, most = len(views.fits), OPTIONS.most_pairs
    if count > most:
        text += f" Of {count} pairs, the figure shows at most {most} of each camera, those of most weight."
    return PageFigure("Votes, curves and lens", text, data_address("image/png", data))


def _draw_pairs(contents: RunContents) -> PageFigure | None:
    matches, views = contents.matches, contents.views
    if matches is None or views is None or not matches.images:
        return None
    order = sorted(matches.images, key=lambda photo: matches.images[photo].name)
    at = {photo: number for number, photo in enumerate(order)}
    grid = np.full((len(order), len(order)), np.nan)
    for (a, b), fit in views.fits.items():
        grid[at[a], at[b]] = grid[at[b], at[a]] = np.log10(max(fit.inlier_count, 1))
    dropped = np.array([(at[a], at[b]) for a, b in views.rejected if a in at and b in at]).reshape(-1, 2)

    def draw(figure: "Figure") -> None:
        axes = figure.add_subplot()
        image = axes.imshow(grid, cmap="viridis", interpolation="nearest")
        bar = figure.colorbar(image, ax=axes, shrink=0.8)
        bar.set_label("inliers of the pair, as a power of ten")
        size = max(1.0, 240.0 / len(order))
        rows, columns = np.concatenate([dropped, dropped[:, ::-1]]).T
        axes.scatter(columns, rows, s=size, marker="x", linewidths=0.6, color=BAD, label="matched, then rejected")
        axes.set(xlabel="photos by name", ylabel="photos by name", facecolor="#f2f2f2")
        if len(dropped):
            axes.legend(loc="upper left", bbox_to_anchor=(0, 1.1), frameon=False, fontsize=8)

    text = (
        "Each cell is a pair of photos. Its color is the number of matches that fit one fundamental matrix; red "
        "crosses are rejected pairs, gray cells are unmatched pairs. Connected photos form blocks."
    )
    return PageFigure("Connected photos", text, _png(draw, (6.4, 5.6)))


def _draw_above(contents: RunContents, figures: ModelFigures | None) -> PageFigure | None:
    scene = contents.scene
    if scene is None or figures is None or not scene.cam_from_world:
        return None
    centers = {name: camera_center(pose) for name, pose in scene.cam_from_world.items()}
    at = np.array(list(centers.values()))
    looks = np.array([pose[2, :3] for pose in scene.cam_from_world.values()])
    ends = [(centers[a], centers[b]) for a, b in _strongest_pairs(contents, centers)]

    def draw(figure: "Figure") -> None:
        left, right = figure.subplots(1, 2)
        _draw_network(left, at, looks, ends, figures.places)
        _draw_overlap(figure, right, at, figures)
        for axes in (left, right):
            _frame(axes, at, figures.places)

    text = (
        "Left: the cameras from above, their viewing directions, and lines between photos that share matches. "
        "Right: the points, and the number of photos that see each. "
        f"{int((figures.tracks > 2).sum())} of {len(figures.tracks)} points are seen by three photos or more."
    )
    return PageFigure("Seen from above", text, _png(draw, (11.0, 5.2)))


def _strongest_pairs(contents: RunContents, centers: Mapping[str, FloatArray]) -> list[tuple[str, ...]]:
    views, matches = contents.views, contents.matches
    if views is None or matches is None:
        return []
    named = {pair: tuple(matches.images[photo].name for photo in pair) for pair in views.fits}
    best = sorted(views.fits, key=lambda pair: (-views.fits[pair].inlier_count, pair))
    return [named[pair] for pair in best if all(name in centers for name in named[pair])][:4000]


def _draw_network(
    axes: "Axes", at: FloatArray, looks: FloatArray, ends: list[tuple[FloatArray, FloatArray]], places: FloatArray
) -> None:
    """Draw cameras at (C, 3) that look along (C, 3), and lines between pairs of them, over the points (P, 3)."""
    from matplotlib.collections import LineCollection

    axes.plot(places[:, 0], places[:, 2], ",", color="#9a9a9a", alpha=0.6)
    flat = [[a[[0, 2]], b[[0, 2]]] for a, b in ends]
    strength = min(0.6, 0.1 + 30.0 / max(len(flat), 1))
    axes.add_collection(LineCollection(flat, colors=INK, linewidths=0.5, alpha=strength))
    axes.quiver(at[:, 0], at[:, 2], looks[:, 0], looks[:, 2], color=ACCENT, angles="xy", scale=24.0, width=0.005)
    axes.plot(at[:, 0], at[:, 2], "o", color=ACCENT, markersize=3.0)
    axes.set_title("cameras, and pairs that share matches", fontsize=9.5)


def _draw_overlap(figure: "Figure", axes: "Axes", at: FloatArray, model: ModelFigures) -> None:
    """Draw the points by number of photos, long tracks on top, and the cameras at (C, 3)."""
    order = np.argsort(model.tracks, kind="stable")
    dots = axes.scatter(
        model.places[order, 0], model.places[order, 2], c=np.minimum(model.tracks[order], LONGEST_TRACK),
        s=2.0, linewidths=0.0, cmap="plasma", vmin=2, vmax=LONGEST_TRACK,
    )  # fmt: skip
    axes.plot(at[:, 0], at[:, 2], "o", color=INK, markersize=2.0)
    figure.colorbar(dots, ax=axes, shrink=0.8, label=f"photos that see the point (up to {LONGEST_TRACK})")
    axes.set_title("overlap", fontsize=9.5)


def _frame(axes: "Axes", at: FloatArray, places: FloatArray) -> None:
    """Set limits for all cameras and nearly all points, with z downwards as seen from above."""
    low, high = at[:, [0, 2]].min(axis=0), at[:, [0, 2]].max(axis=0)
    if len(places):
        near, far = np.percentile(places[:, [0, 2]], [2.0, 98.0], axis=0)
        low, high = np.minimum(low, near), np.maximum(high, far)
    middle, reach = (low + high) / 2, 0.54 * (float((high - low).max()) or 1.0)
    axes.set(aspect="equal", xlabel="x", ylabel="z")
    axes.set_xlim(middle[0] - reach, middle[0] + reach)
    axes.set_ylim(middle[1] + reach, middle[1] - reach)


def _png(draw: Callable[["Figure"], None], size: tuple[float, float]) -> str:
    """Return a figure of this size in inches as a data address."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    file = io.BytesIO()
    with rc_context({"font.size": 9}):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        figure.savefig(file, format="png", dpi=130, metadata={"Software": None})
    return data_address("image/png", file.getvalue())


# Some photos beside their depth maps, in colors from near to far.


MOST_SHOWN = 6
"""Number of depth pictures. By hand."""
SIDE_PX = 480
"""Longer side of each photo, and of the depth map beside it. By hand."""
UNKNOWN = (226, 226, 224)
"""Color of unknown depths: a light gray, which no depth has. By hand."""


@dataclass(frozen=True, slots=True)
class DepthPicture:
    """A photo beside its depth map."""

    name: str
    text: str
    jpeg: bytes
    """The photo at the left, depths at the right."""
    size: tuple[int, int]
    """Width and height in pixels, so that the layout is stable while it loads."""

    @property
    def address(self) -> str:
        """The picture as a data address."""
        return data_address("image/jpeg", self.jpeg)


def depth_pictures(contents: RunContents) -> list[DepthPicture]:
    """Return some photos beside their depth maps."""
    coverage: Mapping[str, float] = contents.counts("depth_maps").get("coverage", {})
    dense = contents.run.workspace.dense
    chosen = spread_names(sorted(coverage), MOST_SHOWN)
    drawn = contents.run.map(lambda name: draw_depths(dense, name), chosen, "depth maps of the report")
    return [
        replace(picture, text=f"{100 * coverage[picture.name]:.0f} % of it has a depth, {picture.text}")
        for picture in drawn
        if picture is not None
    ]


def spread_names(names: Sequence[str], most: int) -> list[str]:
    """Return at most `most` > 0 of the names at even steps, with the first and the last."""
    if not names:
        return []
    places = np.linspace(0, len(names) - 1, min(most, len(names)))
    return [names[round(float(place))] for place in places]


def draw_depths(dense: Path, name: str, kind: Kind = "geometric") -> DepthPicture | None:
    """Return a photo beside its depth map; None, with a line in the log, where one of them cannot be read."""
    try:
        photo, depth = read_photo_and_depth(dense, name, kind)
        scale = min(1.0, SIDE_PX / max(depth.shape))
        size = max(1, round(depth.shape[1] * scale)), max(1, round(depth.shape[0] * scale))
        small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
        nearest = np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), np.float64)
        colors, (near, far) = depth_colors(nearest)
        data = cv2.imencode(".jpg", np.hstack([small, colors])[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 78])[1]
    except (*UNREADABLE, cv2.error) as err:  # the page has the others
        logger.info("no picture of the depths of %s", name, exc_info=err)
        return None
    return DepthPicture(name, f"from {near:.3g} (yellow) to {far:.3g} (violet)", data.tobytes(), (2 * size[0], size[1]))


def depth_colors(depth: FloatArray) -> tuple[ByteArray, tuple[float, float]]:
    """Return the colors (H, W, 3) RGB of depths, yellow near and violet far, and the depths at both ends.

    Colors are even in 1 / depth, as disparities are: otherwise the near half of a scene has one color. Unknown depths
    are <= 0 or not finite; ValueError if all are.
    """
    known = np.isfinite(depth) & (depth > 0.0)
    if not known.any():
        raise ValueError("no pixel has a depth")
    near, far = (float(value) for value in np.percentile(depth[known], (2.0, 98.0)))
    inverse = 1.0 / np.where(known, depth, 1.0)
    span = max(1.0 / near - 1.0 / far, 1e-12)
    level = np.clip((inverse - 1.0 / far) / span, 0.0, 1.0)
    colors = cv2.applyColorMap(np.round(255.0 * level).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(known[..., None], colors, np.array(UNKNOWN, np.uint8)).astype(np.uint8), (near, far)
