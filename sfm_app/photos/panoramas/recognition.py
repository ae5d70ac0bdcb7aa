"""Recognize panoramas: equirectangular photos, whose columns are longitudes and whose rows are latitudes.

Cameras and stitchers say so in the file (Google's Photo Sphere metadata, `GPano`). Without it, a full one is known by
what no other picture has: it is twice as wide as high, its left and right borders continue each other, and its first
and last row each show a single point, the zenith and the nadir.
"""

import re

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.photos.decode import DecodedPhoto, UnreadableError

XMP_KEYS = ("xmp", "XML:com.adobe.xmp")
"""Where Pillow keeps XMP in `Image.info`: JPEG and WebP, PNG."""
XMP_TIFF = 700
ENTRY = re.compile(rb"""<GPano:(\w+)[^>]*>([^<]*)</|GPano:(\w+)\s*=\s*["']([^"']*)""")
"""An entry of Google's metadata, as an element or as an attribute."""
WHOLE = 0.995
"""Least share of the sphere that counts as all of it: stitchers round. Chosen by hand; not measured on its own."""
ASPECT_TOLERANCE = 0.01
"""Largest error of the ratio of width to height, which is 2. Chosen by hand; not measured on its own."""
WIDTH_PX = 512
"""Width at which borders are compared. Chosen by hand; not measured on its own."""
SEAM_STEPS = 3.0
"""Largest difference of the border columns, in median differences of neighboring columns. Chosen on 2:1 parts of real
photos and on rendered panoramas: docs/algorithms.md, Panoramas."""
SEAM_SHARE = 0.5
"""Largest difference of the border columns, as a share of the least difference of one of them to any column an eighth
of a turn or more away. Chosen as `SEAM_STEPS`."""
LEAST_CONTRAST = 10.0
"""Standard deviation of a border column in gray levels, below which it cannot be told from others. Chosen by hand; not
measured on its own."""
POLE_SHARE = 0.2
"""Largest mean step from column to column of the first and the last row, as a share of that of the busiest row: a point
that is stretched over the whole width hardly changes. Chosen as `SEAM_STEPS`."""


def is_panorama(picture: DecodedPhoto, upright: Image.Image) -> bool:
    """Return whether a photo is a full equirectangular panorama, by its metadata or else by its pixels. Ours.

    Args:
        picture: what the file holds.
        upright: its picture, upright.

    Raises:
        UnreadableError: it is a panorama that does not show the whole sphere, or one of another projection.
    """
    entries = read_panorama_entries(picture.image)
    kind = entries.get("ProjectionType", "").strip().lower()
    if not kind:
        return closes_around(upright)
    if kind != "equirectangular":
        raise UnreadableError(f"a panorama of the projection '{kind[:40]}': only equirectangular ones can be used")
    wide, high = (_covered_share(entries, side) for side in ("Width", "Height"))
    if min(wide, high) < WHOLE:
        degrees = f"{360 * wide:.0f} x {180 * high:.0f} degrees"
        raise UnreadableError(f"a panorama of {degrees}: only full ones of 360 x 180 degrees can be used")
    if not _is_twice_as_wide(upright.size):
        raise UnreadableError("a part of a panorama: said to be all round, but not twice as wide as high")
    return True


def read_panorama_entries(image: Image.Image) -> dict[str, str]:
    """Return the entries of Google's Photo Sphere metadata by name; empty without.

    Args:
        image: decoded, as stored in the file.
    """
    found = next((image.info[key] for key in XMP_KEYS if image.info.get(key)), None)
    if found is None and image.format == "TIFF":
        found = getattr(image, "tag_v2", {}).get(XMP_TIFF)
    if isinstance(found, str):
        found = found.encode()
    if not isinstance(found, bytes):
        return {}
    entries = ((a or c, b or d) for a, b, c, d in ENTRY.findall(found))
    return {name.decode(): value.decode(errors="replace").strip() for name, value in entries}


def closes_around(upright: Image.Image) -> bool:
    """Return whether a picture looks like a full panorama: its borders continue each other, its poles are points. Ours.

    Args:
        upright: upright picture.
    """
    if not _is_twice_as_wide(upright.size):
        return False
    small = upright.convert("RGB").resize((WIDTH_PX, WIDTH_PX // 2), Image.Resampling.BOX, reducing_gap=3.0)
    pixels = np.asarray(small, np.float64)
    busy = np.abs(np.diff(pixels, axis=1)).mean(axis=(1, 2))
    return bool(max(busy[0], busy[-1]) <= POLE_SHARE * busy.max()) and _borders_continue(pixels)


def _borders_continue(pixels: NDArray[np.float64]) -> bool:
    """Return whether the last column continues in the first, and far better than in any other."""
    width, edge = pixels.shape[1], (pixels[:, :1], pixels[:, -1:])
    if min(float(np.std(column.mean(axis=2))) for column in edge) < LEAST_CONTRAST:
        return False
    seam = _difference(edge[0], edge[1])[0]
    steps = _difference(pixels[:, 1:], pixels[:, :-1])
    far = slice(width // 8, -(width // 8))
    others = min(_difference(column, pixels[:, far]).min() for column in edge)
    return bool(seam <= SEAM_STEPS * np.median(steps) and seam <= SEAM_SHARE * others)


def _difference(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean absolute difference (N,) of columns (H, N, 3)."""
    return np.asarray(np.mean(np.abs(a - b), axis=(0, 2)), np.float64)


def _is_twice_as_wide(size: tuple[int, int]) -> bool:
    return abs(size[0] / size[1] - 2.0) <= ASPECT_TOLERANCE


def _covered_share(entries: dict[str, str], side: str) -> float:
    """Return the share of the sphere that the picture covers along its width or height, 1 where nothing is said."""
    try:
        part, whole = (float(entries[name]) for name in (f"CroppedAreaImage{side}Pixels", f"FullPano{side}Pixels"))
        return min(part / whole, 1.0) if part > 0 else 1.0
    except (KeyError, ValueError, ZeroDivisionError):
        return 1.0
