"""One row for each photo: whether it has its place, why not, and how well it is tied to the model."""

import base64
import io
import logging
import math
from collections import Counter
from collections.abc import Mapping
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
    """Address of a small picture; empty where there is none."""


def photo_rows(contents: RunContents, figures: ModelFigures | None, pictures: Mapping[str, str]) -> list[PhotoRow]:
    """Return the rows of all photos, in order of their names, those that were left out last.

    Args:
        contents: of the run.
        figures: of its model; None where there is none.
        pictures: addresses of small pictures, by name of the photo; may lack some.
    """
    if contents.photos is None:
        return []
    photos = contents.photos.photos
    pairs, inliers = _count_pairs(contents)
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


def photo_names(contents: RunContents) -> list[str]:
    """Return the names of the usable photos in order of the page's rows."""
    return sorted(photo.name for photo in contents.photos.photos) if contents.photos is not None else []


def embedded_pictures(contents: RunContents) -> Mapping[str, str]:
    """Return small pictures of all photos as data addresses, by name.

    Args:
        contents: of the run.
    """
    names, folder = photo_names(contents), contents.run.workspace.photos
    side = picture_side(max(len(names), 1))
    found = contents.run.map(lambda name: _address(picture(folder / name, side)), names, "pictures of the report")
    return dict(zip(names, found, strict=True))


def picture_side(count: int) -> int:
    """Return the longer side of each picture, so that all together stay small.

    Args:
        count: of the pictures, > 0.
    """
    return int(min(max(math.sqrt(ALL_PIXELS / max(count, 1) * 4 / 3), SMALLEST_PX), LARGEST_PX))


def picture(path: Path, side: int) -> bytes:
    """Return a picture of a photo as JPEG; empty where the photo can no longer be read.

    Args:
        path: of the photo.
        side: most pixels of its longer side.
    """
    try:
        with Image.open(path) as image:
            image.draft("RGB", (side, side))
            small = image.convert("RGB")
            small.thumbnail((side, side))
            file = io.BytesIO()
            small.save(file, "JPEG", quality=QUALITY)
    except (OSError, ValueError, Image.DecompressionBombError) as err:  # the photo may be gone
        logger.info("no picture of %s", path.name, exc_info=err)
        return b""
    return file.getvalue()


def _address(jpeg: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii") if jpeg else ""
