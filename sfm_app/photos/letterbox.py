"""Bars of one color around a picture: what services add to bring photos of any size to one.

The picture within is the photo: its size tells cameras apart, and its middle, not that of the whole, is where the
optical center usually lies. A bar is of one color, and ends at a straight edge, all along which the picture differs
from it; a black background or a blown-out sky does not end like that.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.types import Frame, Photo

ALIKE = 8
"""Gray levels by which a bar may differ from its color: JPEG leaves fewer, but for what rings beside the edge."""
STRAY = 0.01
"""Share of a line that may differ by more."""
UNLIKE, LEAST_EDGE = 16, 0.7
"""Gray levels by which so large a share of the line behind the edge must differ from the bar."""
BLUR_PX, RINGING_PX = 3, 18
"""Lines from the first that is not of one color to the picture: resizing blurs the edge, and JPEG rings as far as its
blocks of color reach, 16 pixels; then the bar ends where the picture begins."""
LEAST_PX, LEAST_SHARE = 4, 0.008
"""A thinner bar, in pixels and in shares of the side, moves nothing."""
MOST_SHARE = 0.7
"""Bars that leave less than the rest of a side are no bars, but a thing before a plain ground."""
SAME_PX, SAME_SHARE = 4.0, 0.01
"""Pictures whose edges lie that close to each other, in pixels or in shares of the longer side, have one size."""


def shown_part(picture: Image.Image) -> Frame | None:
    """Return the picture within bars; None where there are none.

    A bar above without one below is not believed: it may be a sky of one color above a level horizon.
    """
    pixels = np.asarray(picture.convert("RGB"))
    height, width = pixels.shape[:2]
    top, bottom = _bar(pixels), _bar(pixels[::-1])
    if top and not bottom:
        top = 0
    columns = pixels[top : height - bottom].transpose(1, 0, 2)
    left, right = _bar(columns), _bar(columns[::-1])
    if not any((left, top, right, bottom)):
        return None
    return left, top, width - left - right, height - top - bottom


def with_one_frame(photos: Sequence[Photo]) -> Iterator[Photo]:
    """Yield photos of one size with the pictures within them made equal where they nearly are.

    Where all bars that are seen are alike, photos whose bars are not seen (a sky of their color) have them, too. Bars
    around fewer than half of the photos are not believed: a wall before an empty ground ends at straight edges, too.
    """
    if 2 * sum(photo.shown is not None for photo in photos) < len(photos):
        photos = [replace(photo, shown=None) for photo in photos]
    frames: list[list[Frame]] = []
    which: list[int] = []
    for photo in photos:
        own = photo.shown or (0, 0, photo.width, photo.height)
        near = max(SAME_PX, SAME_SHARE * max(photo.width, photo.height))
        alike = [k for k, known in enumerate(frames) if np.max(np.abs(_edges(known[0]) - _edges(own))) <= near]
        if not alike:
            frames.append([])
        which.append(alike[0] if alike else len(frames) - 1)
        frames[which[-1]].append(own)
    seen = {number for number, photo in zip(which, photos, strict=True) if photo.shown}
    hidden = [photo for photo in photos if not photo.shown]
    if len(seen) == 1 and 2 * len(hidden) <= len(photos):
        which = [*seen] * len(photos)
    for photo, number in zip(photos, which, strict=True):
        edges = np.median([_edges(frame) for frame in frames[number]], axis=0)
        left, top, right, bottom = (round(float(value)) for value in edges)
        whole = (left, top, right, bottom) == (0, 0, photo.width, photo.height)
        yield replace(photo, shown=None if whole else (left, top, right - left, bottom - top))


def _edges(frame: Frame) -> NDArray[np.int64]:
    left, top, width, height = frame
    return np.array([left, top, left + width, top + height])


def _bar(lines: NDArray[np.uint8]) -> int:
    """Return how many of the first lines (N, M, 3) are a bar."""
    color = np.median(lines[0], axis=0).astype(np.int16)
    most = int(MOST_SHARE * len(lines))
    first = next((k for k in range(most) if _share(lines[k], color, ALIKE) > STRAY), 0)
    if first < max(LEAST_PX, LEAST_SHARE * len(lines)):
        return 0
    behind = range(first, min(first + RINGING_PX, most))
    unlike = [_share(lines[k], color, UNLIKE) for k in behind]
    edge = next((k for k, share in zip(behind, unlike, strict=True) if share >= LEAST_EDGE), 0)
    if sum(share >= LEAST_EDGE / 2 for share in unlike[: max(edge - first, 0)]) > BLUR_PX:
        return 0  # the edge slopes: a thing ends there, not the picture
    return first if 0 < edge <= first + BLUR_PX else edge


def _share(line: NDArray[np.uint8], color: NDArray[np.int16], levels: int) -> float:
    """Return share of a line (M, 3) that differs from a color by more."""
    return float(np.mean(np.max(np.abs(line.astype(np.int16) - color), axis=1) > levels))
