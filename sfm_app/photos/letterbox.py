"""Find bars of one color around a picture, which services add to bring photos of any size to one size.

The picture within the bars is the photo: its size distinguishes cameras, and the optical center usually lies near its
middle, not near the middle of the whole. A bar has one color and ends at a straight edge, along which the whole picture
differs from it; a black background or an overexposed sky does not end like that.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.types import Frame, Photo

BAR_TOLERANCE = 8
"""Gray levels by which a bar may differ from its color: JPEG changes it by less, except for ringing beside the edge."""
STRAY_SHARE = 0.01
"""Share of the pixels of a line that may differ by more."""
EDGE_CONTRAST, LEAST_EDGE = 16, 0.7
"""Gray levels by which the line behind the edge must differ from the bar, and the share of its pixels that must."""
BLUR_PX, RINGING_PX = 3, 18
"""Largest distance, in lines, from the end of the uniform bar to the picture: resizing blurs the edge, and JPEG rings
as far as its chroma blocks reach, 16 pixels. With ringing, the bar ends where the picture begins."""
LEAST_PX, LEAST_SHARE = 4, 0.008
"""Thinner bars, in pixels and in shares of the side, are ignored: they hardly move the middle."""
MOST_SHARE = 0.7
"""Largest share of a side that a bar may cover; beyond, it is an object in front of a plain background."""
SAME_PX, SAME_SHARE = 4.0, 0.01
"""Pictures whose edges differ by at most this, in pixels or in shares of the longer side, count as one size."""


def shown_part(picture: Image.Image) -> Frame | None:
    """Return the frame of the picture within bars; None without bars.

    A bar above without one below is ignored: it may be a sky of one color above a level horizon.
    """
    pixels = np.asarray(picture.convert("RGB"))
    height, width = pixels.shape[:2]
    top, bottom = _bar_thickness(pixels), _bar_thickness(pixels[::-1])
    if top and not bottom:
        top = 0
    columns = pixels[top : height - bottom].transpose(1, 0, 2)
    left, right = _bar_thickness(columns), _bar_thickness(columns[::-1])
    if not any((left, top, right, bottom)):
        return None
    return left, top, width - left - right, height - top - bottom


def unify_frames(photos: Sequence[Photo]) -> Iterator[Photo]:
    """Yield photos of one size, with nearly equal picture frames replaced by their median.

    If all detected bars agree, photos without detected bars (for example, with a sky of the same color) get them too.
    Bars around fewer than half of the photos are ignored: a wall in front of an empty background also ends at straight
    edges.
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


def _bar_thickness(lines: NDArray[np.uint8]) -> int:
    """Return how many of the first lines of (N, M, 3) form a bar."""
    color = np.median(lines[0], axis=0).astype(np.int16)
    most = int(MOST_SHARE * len(lines))
    first = next((k for k in range(most) if _differing_share(lines[k], color, BAR_TOLERANCE) > STRAY_SHARE), 0)
    if first < max(LEAST_PX, LEAST_SHARE * len(lines)):
        return 0
    behind = range(first, min(first + RINGING_PX, most))
    unlike = [_differing_share(lines[k], color, EDGE_CONTRAST) for k in behind]
    edge = next((k for k, share in zip(behind, unlike, strict=True) if share >= LEAST_EDGE), 0)
    if sum(share >= LEAST_EDGE / 2 for share in unlike[: max(edge - first, 0)]) > BLUR_PX:
        return 0  # a sloping edge belongs to an object, not to a bar
    return first if 0 < edge <= first + BLUR_PX else edge


def _differing_share(line: NDArray[np.uint8], color: NDArray[np.int16], levels: int) -> float:
    """Return the share of a line (M, 3) that differs from a color by more than `levels`."""
    return float(np.mean(np.max(np.abs(line.astype(np.int16) - color), axis=1) > levels))
