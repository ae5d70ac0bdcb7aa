"""One row for each photo: whether it has its place, why not, and how well it is tied to the model."""

import base64
import io
import logging
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from sfm_app.colmap.figures.observations import ModelFigures
from sfm_app.report.page.contents import RunContents
from sfm_app.types import Photo

logger = logging.getLogger("sfm_app")

PLACED, ELSEWHERE, UNPLACED, LEFT_OUT, USABLE = "placed", "in another model", "not placed", "left out", "usable"
ALL_PIXELS, LARGEST_PX, SMALLEST_PX = 6_000_000, 960, 160
"""Pixels of all pictures together, and bounds of their longer side: some 10 MB for any number of photos."""
QUALITY = 72
"""JPEG quality of the pictures. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class PhotoRow:
    """What the page says of one photo; None where it is not known."""

    name: str
    state: str
    reason: str = ""
    pairs: int | None = None
    """Pairs of photos that it is in."""
    inliers: int | None = None
    points: int | None = None
    residual_px: float | None = None
    coverage: float | None = None
    """Share of the photo with points of the model."""
    depth: float | None = None
    """Share of the photo with a depth."""
    picture: str = ""
    """JPEG as a data address; empty where there is none."""


def photo_rows(contents: RunContents, figures: ModelFigures | None) -> list[PhotoRow]:
    """Return the rows of all photos, in order of their names, those that were left out last.

    Args:
        contents: of the run.
        figures: of its model; None where there is none.
    """
    if contents.photos is None:
        return []
    photos = contents.photos.photos
    pairs, inliers = _count_pairs(contents)
    pictures = _pictures(photos, contents)
    depths = contents.counts("depth_maps").get("coverage", {})
    rows = []
    for photo in sorted(photos, key=lambda one: one.name):
        state, reason = _state(photo, contents)
        seen = figures.photos.get(photo.name) if figures is not None else None
        rows.append(
            PhotoRow(
                photo.path, state, "; ".join(filter(None, (reason, *photo.notes))),
                pairs.get(photo.name, 0) if contents.views is not None else None,
                inliers.get(photo.name, 0) if contents.views is not None else None,
                seen.points if seen else None,
                seen.residual_px if seen and math.isfinite(seen.residual_px) else None,
                seen.coverage if seen else None,
                depths.get(photo.name), pictures.get(photo.name, ""),
            )
        )  # fmt: skip
    return rows + [PhotoRow(one.name, LEFT_OUT, one.reason) for one in contents.photos.unusable]


def _state(photo: Photo, contents: RunContents) -> tuple[str, str]:
    """Return whether a photo has its place, and why not."""
    scene = contents.scene
    if scene is None:
        return USABLE, ""
    if photo.name in scene.cam_from_world:
        return PLACED, ""
    others = contents.counts("scene").get("other_models", ())
    number = next((k for k, names in enumerate(others, 1) if photo.name in names), 0)
    if number:
        return ELSEWHERE, f"in other_models/{number}, which no pair connects with the main one"
    return UNPLACED, scene.unregistered.get(photo.name, "")


def _count_pairs(contents: RunContents) -> tuple[Counter[str], Counter[str]]:
    """Return the pairs that each photo is in, and their inliers, by name."""
    pairs, inliers = Counter[str](), Counter[str]()
    if contents.views is None or contents.matches is None:
        return pairs, inliers
    for pair, fit in contents.views.fits.items():
        for photo in pair:
            name = contents.matches.images[photo].name
            pairs[name] += 1
            inliers[name] += fit.inlier_count
    return pairs, inliers


def _pictures(photos: Sequence[Photo], contents: RunContents) -> Mapping[str, str]:
    """Return small pictures of photos as data addresses, by name."""
    side = picture_side(len(photos))
    folder = contents.run.workspace.photos
    found = contents.run.map(lambda photo: _picture(folder / photo.name, side), photos, "pictures of the report")
    return dict(zip((photo.name for photo in photos), found, strict=True))


def picture_side(count: int) -> int:
    """Return the longer side of each picture, so that all together stay small.

    Args:
        count: of the pictures, > 0.
    """
    return int(min(max(math.sqrt(ALL_PIXELS / max(count, 1) * 4 / 3), SMALLEST_PX), LARGEST_PX))


def _picture(path: Path, side: int) -> str:
    """Return a small picture of a photo as a data address; empty where it can no longer be read."""
    try:
        with Image.open(path) as image:
            image.draft("RGB", (side, side))
            small = image.convert("RGB")
            small.thumbnail((side, side))
            file = io.BytesIO()
            small.save(file, "JPEG", quality=QUALITY)
    except (OSError, ValueError, Image.DecompressionBombError) as err:  # the photo may be gone
        logger.info("no picture of %s", path.name, exc_info=err)
        return ""
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode("ascii")
