"""Some photos beside their depth maps, in colors from near to far."""

import base64
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.figures.depths import read_photo_and_depth
from sfm_app.report.page.contents import UNREADABLE, RunContents

FloatArray = NDArray[np.float64]
ByteArray = NDArray[np.uint8]

logger = logging.getLogger("sfm_app")

MOST_SHOWN = 6
"""Photos that are shown, spread over the set. Chosen by hand."""
SIDE_PX = 480
"""Longer side of each picture, and of the depth map beside it."""
QUALITY = 78
"""JPEG quality. Chosen by hand: colors of neighboring depths stay apart."""
ENDS = (2.0, 98.0)
"""Percentiles of the known depths at the ends of the colors: single wrong depths are as far as one likes."""
UNKNOWN = (226, 226, 224)
"""Color where there is no depth: a light gray, which is none of the colors of depths."""


@dataclass(frozen=True, slots=True)
class DepthPicture:
    """A photo beside its depth map."""

    name: str
    text: str
    """What one sees; also what is read out instead of it."""
    address: str
    """JPEG as a data address: the photo at the left, depths at the right."""
    size: tuple[int, int]
    """Its width and height in pixels, so that nothing on the page moves while it loads."""


@dataclass(frozen=True, slots=True)
class DepthPictures:
    """Photos with their depth maps, spread over the set."""

    pictures: Sequence[DepthPicture]
    count: int
    """Photos, or views of wide photos, that have a depth map."""


def depth_pictures(contents: RunContents) -> DepthPictures | None:
    """Return some photos beside their depth maps; None where there is none to show.

    Args:
        contents: of the run.
    """
    coverage: Mapping[str, float] = contents.counts("depth_maps").get("coverage", {})
    dense = contents.run.workspace.dense
    chosen = spread_names(sorted(coverage), MOST_SHOWN)
    found = contents.run.map(lambda name: _draw(dense, name, coverage[name]), chosen, "depth maps of the report")
    pictures = [picture for picture in found if picture is not None]
    return DepthPictures(pictures, len(coverage)) if pictures else None


def spread_names(names: Sequence[str], most: int) -> list[str]:
    """Return some of the names at even steps, with the first and the last.

    Args:
        names: in order.
        most: of them, > 0.
    """
    if not names:
        return []
    places = np.linspace(0, len(names) - 1, min(most, len(names)))
    return [names[round(float(place))] for place in places]


def _draw(dense: Path, name: str, share: float) -> DepthPicture | None:
    """Return one photo beside its depths; None where a file is missing or damaged."""
    try:
        photo, depth = read_photo_and_depth(dense, name)
        size = _shrunk_size(depth.shape[1], depth.shape[0])
        small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
        nearest = np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), np.float64)
        colors, (near, far) = depth_colors(nearest)
        data = cv2.imencode(".jpg", np.hstack([small, colors])[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    except (*UNREADABLE, cv2.error) as err:  # the page has the others
        logger.info("no picture of the depths of %s", name, exc_info=err)
        return None
    text = f"{100 * share:.0f} % of it has a depth, from {near:.3g} (yellow) to {far:.3g} (violet)"
    address = "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")
    return DepthPicture(name, text, address, (2 * size[0], size[1]))


def depth_colors(depth: FloatArray) -> tuple[ByteArray, tuple[float, float]]:
    """Return the colors (H, W, 3) RGB of depths, yellow near and violet far, and the depths at both ends.

    Colors are even in 1 / depth, as disparities are: the near half of a scene would else have one color.

    Args:
        depth: (H, W), <= 0 or not finite where there is none.

    Raises:
        ValueError: no pixel has a depth.
    """
    known = np.isfinite(depth) & (depth > 0.0)
    if not known.any():
        raise ValueError("no pixel has a depth")
    near, far = (float(value) for value in np.percentile(depth[known], ENDS))
    inverse = 1.0 / np.where(known, depth, 1.0)
    span = max(1.0 / near - 1.0 / far, 1e-12)
    level = np.clip((inverse - 1.0 / far) / span, 0.0, 1.0)
    colors = cv2.applyColorMap(np.round(255.0 * level).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(known[..., None], colors, np.array(UNKNOWN, np.uint8)).astype(np.uint8), (near, far)


def _shrunk_size(width: int, height: int) -> tuple[int, int]:
    """Return width and height at most SIDE_PX long, in the same ratio."""
    scale = min(1.0, SIDE_PX / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))
