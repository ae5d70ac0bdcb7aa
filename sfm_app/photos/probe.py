"""Which photos share one camera."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.photos.decode import (
    LOSSY,
    MOST_FRAMES,
    DecodedPhoto,
    UnreadableError,
    camera_name,
    focal_px,
    gps_position,
    large_photo_lock,
    orientation,
    read_picture,
    rotate_to_sensor,
    turn_deg,
    upright_image,
)
from sfm_app.photos.files import resolve_file
from sfm_app.photos.panoramas import is_panorama
from sfm_app.photos.selection import PhotoStats, measure_photo
from sfm_app.settings import PhotoSettings
from sfm_app.types import Frame, GivenCameras, Photo, UnusablePhoto
from sfm_app.types.camera import EQUIRECTANGULAR, PERSPECTIVE

# Find bars of one color around a picture, which services add to bring photos of any size to one size.
#
# The picture within the bars is the photo: its size distinguishes cameras, and the optical center usually lies near
# its middle, not near the middle of the whole. A bar has one color and ends at a straight edge, along which the
# whole picture differs from it; a black background or an overexposed sky does not end like that.

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


# Examine one file of the folder: a usable photo, or the reason why it is not one.

MEGA = 1_000_000
LINKED_FORMATS = ("JPEG", "MPO", "PNG")
"""Formats that COLMAP reads and writes without conversion."""


def read_photo(folder: Path, name: str, *, options: PhotoSettings) -> PhotoStats | UnusablePhoto:
    """Decode one file to check that it is intact, and measure what is needed to compare it with other photos."""
    place = resolve_file(folder, name)
    if isinstance(place, str):
        return UnusablePhoto(name, place)
    try:
        with large_photo_lock(place):
            return describe(name, read_picture(place), options)
    except UnreadableError as err:
        return UnusablePhoto(name, str(err))


def describe(name: str, picture: DecodedPhoto, options: PhotoSettings) -> PhotoStats | UnusablePhoto:
    """Return a photo's metadata and image statistics.

    Raises:
        UnreadableError: it is a panorama that does not show the whole sphere.
    """
    image, exif = picture.image, picture.exif
    upright = upright_image(picture)
    panorama = is_panorama(picture, upright)
    turn = 0 if panorama else turn_deg(exif)  # rows of a panorama are latitudes
    size = image.size[::-1] if orientation(exif) >= 5 and not turn else image.size
    if min(size) < options.min_side_px:
        return UnusablePhoto(name, f"smaller than {options.min_side_px} px")
    width, height = scaled_size(size, options.max_megapixels * MEGA)
    many = f"its {picture.frames}" if picture.frames <= MOST_FRAMES else f"more than {MOST_FRAMES}"
    notes = [f"the first of {many} pictures"] if picture.frames > 1 else []
    if (width, height) != size:
        notes.append(f"scaled down from {size[0]} x {size[1]} to {width} x {height} pixels")
    if panorama:
        notes.append("a panorama of 360 x 180 degrees")
    eight_bit = image.mode in ("RGB", "L") and "transparency" not in image.info
    photo = Photo(
        name=name,
        width=width,
        height=height,
        group=camera_name(exif),
        exif_focal_px=None if panorama else focal_px(exif, max(width, height)),
        needs_copy=not (
            image.format in LINKED_FORMATS and eight_bit and orientation(exif) == 1 and (width, height) == size
        ),
        gps=gps_position(exif),
        lossy=image.format in LOSSY,
        turn_deg=turn,
        notes=tuple(notes),
        projection=EQUIRECTANGULAR if panorama else PERSPECTIVE,
    )
    return measure_photo(photo if panorama else replace(photo, shown=_shown_frame(upright, photo)), upright)


def _shown_frame(seen: Image.Image, photo: Photo) -> Frame | None:
    """Return the frame of the picture within bars, in pixels of the laid-out photo."""
    laid = rotate_to_sensor(seen, photo.turn_deg)
    found = shown_part(laid)
    if found is None or laid.size == (photo.width, photo.height):
        return found
    x, y = photo.width / laid.width, photo.height / laid.height
    return round(found[0] * x), round(found[1] * y), round(found[2] * x), round(found[3] * y)


def scaled_size(size: tuple[int, int], most_px: float) -> tuple[int, int]:
    """Return width and height after shrinking a picture to at most `most_px` pixels.

    Args:
        size: width and height in pixels.
        most_px: pixels in all, >= 1.
    """
    share = min(1.0, (most_px / (size[0] * size[1])) ** 0.5)
    return max(1, int(size[0] * share)), max(1, int(size[1] * share))


PORTRAIT_TURN_DEG = 90
"""Rotation assumed for a portrait photo whose EXIF does not give one. The opposite rotation would only mirror the
optical center, which lies near the middle."""


def group_by_camera(photos: Sequence[Photo], cameras: str) -> Iterator[Photo]:
    """Yield photos with their groups, in their order; photos of one group share one camera.

    A camera in COLMAP has one image size. Photos without an EXIF rotation are therefore turned to the more common
    orientation of their camera; photos that still differ in size get different groups. With "auto", so do letterboxed
    photos whose pictures within the bars differ in size. Panoramas of one size always share one, with no other photos.
    """
    photos = _complete_panoramas(photos)
    sizes = Counter((_camera_key(photo, cameras), photo.width, photo.height) for photo in photos)
    found = []
    for photo in photos:
        maker = _camera_key(photo, cameras)
        here, across = (sizes[maker, *size] for size in ((photo.width, photo.height), (photo.height, photo.width)))
        on_end = across > here or (across == here and photo.height > photo.width)
        laid = _rotate(photo) if across and on_end and not photo.turn_deg else photo
        found.append(replace(laid, group=" ".join(filter(None, (f"{laid.width}x{laid.height}", maker)))))
    yield from _split_by_shown_size(found) if cameras == "auto" else (replace(photo, shown=None) for photo in found)


def _complete_panoramas(photos: Sequence[Photo]) -> list[Photo]:
    """Return the photos, where most of a size are panoramas with all of that size as panoramas.

    A panorama without metadata is known by its borders, which may be a blank wall.
    """
    sizes = Counter((photo.width, photo.height) for photo in photos)
    around = Counter((photo.width, photo.height) for photo in photos if photo.projection == EQUIRECTANGULAR)
    most = {size for size, count in around.items() if count > sizes[size] / 2 and size[0] == 2 * size[1]}
    return [
        replace(photo, projection=EQUIRECTANGULAR) if (photo.width, photo.height) in most else photo for photo in photos
    ]


def split_by_given_camera(photos: Sequence[Photo], given: GivenCameras) -> list[Photo]:
    """Return the photos with groups of their own for those to which a calibration file gives different cameras."""
    names: dict[str, set[str]] = {}
    for photo in photos:
        if name := given.camera_name(photo.name):
            names.setdefault(photo.group, set()).add(name)
    mixed = {group for group, cameras in names.items() if len(cameras) > 1}
    found = []
    for photo in photos:
        name = given.camera_name(photo.name) if photo.group in mixed else None
        found.append(replace(photo, group=f"{photo.group} by {name}") if name else photo)
    return found


def _split_by_shown_size(photos: Sequence[Photo]) -> list[Photo]:
    """Give letterboxed photos with different picture sizes groups of their own."""
    groups: dict[str, list[int]] = {}
    for place, photo in enumerate(photos):
        groups.setdefault(photo.group, []).append(place)
    found = list(photos)
    for places in groups.values():
        for place, photo in zip(places, unify_frames([photos[place] for place in places]), strict=True):
            inside = f"{photo.shown[2]}x{photo.shown[3]} in " if photo.shown else ""
            found[place] = replace(photo, group=inside + photo.group)
    return found


def _camera_key(photo: Photo, cameras: str) -> str:
    if photo.projection == EQUIRECTANGULAR:
        return EQUIRECTANGULAR  # its projection is known, and no camera that was named has it
    return {
        "auto": photo.group,
        "single": "",
        "folder": PurePosixPath(photo.path).parent.as_posix(),
        "each": photo.path,
    }[cameras]


def _rotate(photo: Photo) -> Photo:
    shown = photo.shown
    if shown is not None:
        left, top, width, height = shown
        shown = (top, photo.width - left - width, height, width)
    return replace(
        photo, width=photo.height, height=photo.width, turn_deg=PORTRAIT_TURN_DEG, needs_copy=True, shown=shown
    )
