"""Photos from files: their metadata, the picture within bars, and the camera they share with others."""

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
    exif_prior,
    gps_position,
    large_photo_lock,
    opaque_pixels,
    orientation,
    read_picture,
    rotate_to_sensor,
    turn_deg,
    upright_image,
    xmp_entries,
)
from sfm_app.photos.files import resolve_file
from sfm_app.photos.panoramas import is_panorama
from sfm_app.photos.selection import PhotoStats, measure_photo
from sfm_app.settings import PhotoSettings
from sfm_app.types import Frame, GivenCameras, Photo, UnusablePhoto
from sfm_app.types.arrays import ByteArray, FloatArray, IndexArray
from sfm_app.types.camera import EQUIRECTANGULAR, PERSPECTIVE
from sfm_app.types.photos import FILE, SEA_LEVEL, TAKE_OFF

# Bars of one color around a picture, which services add to bring photos of any size to one size.
# The picture within the bars is the photo: its size distinguishes cameras, and the principal point usually lies near
# its middle. A bar has one color and ends at a straight edge, along which the whole picture differs from it; a black
# background or an overexposed sky does not end like that.


class BARS:
    """Constants of the detection of bars; sides are those of the picture across a bar."""

    tolerance: int = 8
    """Gray levels by which a bar may differ from its color: JPEG stays below, except for ringing at the edge."""
    stray_share: float = 0.01
    """Share of the pixels of a line that may differ more."""
    edge_contrast: int = 16
    """Gray levels by which the line behind the edge must differ from the bar."""
    min_edge: float = 0.7
    """Least share of its pixels that must."""
    blur_px: int = 3
    """Largest number of lines between bar and picture that resizing blurs."""
    ringing_px: int = 18
    """Largest number of lines that JPEG rings: a chroma block has 16. The bar then ends where the picture begins."""
    min_px: int = 4
    """Thinner bars are ignored: they hardly move the middle."""
    min_share: float = 0.008
    """The same, as a share of the side."""
    max_share: float = 0.7
    """Largest share of the side; a wider bar is the background of an object."""
    same_px: float = 4.0
    """Largest difference of the edges of pictures of one size."""
    same_share: float = 0.01
    """The same, as a share of the longer side; the larger one counts."""


def shown_part(picture: Image.Image) -> Frame | None:
    """Return the frame of the picture within bars; None without bars. A bar above alone may be a sky, and is none."""
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


def unify_frames(photos: Sequence[Photo]) -> list[Photo]:
    """Return photos of one size, with nearly equal picture frames replaced by their median.

    If all detected bars agree, photos without detected bars (with a sky of the same color, say) get them too. Bars
    around fewer than half of the photos are ignored: a wall in front of a plain background also ends at straight edges.
    """
    if 2 * sum(photo.shown is not None for photo in photos) < len(photos):
        photos = [replace(photo, shown=None) for photo in photos]
    clusters, numbers = _cluster_frames(photos)
    barred = {number for number, photo in zip(numbers, photos, strict=True) if photo.shown}
    if len(barred) == 1 and 2 * sum(not photo.shown for photo in photos) <= len(photos):
        numbers = [*barred] * len(photos)
    medians = [np.median([_edges(frame) for frame in frames], axis=0) for frames in clusters]
    return [replace(one, shown=_frame_within(one, medians[k])) for one, k in zip(photos, numbers, strict=True)]


def _cluster_frames(photos: Sequence[Photo]) -> tuple[list[list[Frame]], list[int]]:
    """Return the picture frames in clusters of nearly equal ones, and the number of each photo's cluster."""
    clusters: list[list[Frame]] = []
    numbers: list[int] = []
    for photo in photos:
        frame = photo.shown or (0, 0, photo.width, photo.height)
        limit = max(BARS.same_px, BARS.same_share * max(photo.width, photo.height))
        near = (k for k, known in enumerate(clusters) if np.max(np.abs(_edges(known[0]) - _edges(frame))) <= limit)
        number = next(near, len(clusters))
        if number == len(clusters):
            clusters.append([])
        numbers.append(number)
        clusters[number].append(frame)
    return clusters, numbers


def _frame_within(photo: Photo, edges: FloatArray) -> Frame | None:
    """Return the frame with these edges; None if it is the whole photo."""
    left, top, right, bottom = (round(float(value)) for value in edges)
    whole = (left, top, right, bottom) == (0, 0, photo.width, photo.height)
    return None if whole else (left, top, right - left, bottom - top)


def _edges(frame: Frame) -> IndexArray:
    left, top, width, height = frame
    return np.array([left, top, left + width, top + height])


def _bar_thickness(lines: ByteArray) -> int:
    """Return how many of the first lines of (N, M, 3) form a bar."""
    color = np.median(lines[0], axis=0).astype(np.int16)
    most = int(BARS.max_share * len(lines))
    strays = (k for k in range(most) if _differing_share(lines[k], color, BARS.tolerance) > BARS.stray_share)
    first = next(strays, 0)
    if first < max(BARS.min_px, BARS.min_share * len(lines)):
        return 0
    behind = range(first, min(first + BARS.ringing_px, most))
    shares = [_differing_share(lines[k], color, BARS.edge_contrast) for k in behind]
    edge = next((k for k, share in zip(behind, shares, strict=True) if share >= BARS.min_edge), 0)
    if sum(share >= BARS.min_edge / 2 for share in shares[: max(edge - first, 0)]) > BARS.blur_px:
        return 0  # a sloping edge belongs to an object, not to a bar
    return first if 0 < edge <= first + BARS.blur_px else edge


def _differing_share(line: ByteArray, color: NDArray[np.int16], levels: int) -> float:
    """Return the share of a line (M, 3) that differs from a color by more than `levels`."""
    return float(np.mean(np.max(np.abs(line.astype(np.int16) - color), axis=1) > levels))


def read_photo(folder: Path, name: str, *, options: PhotoSettings) -> PhotoStats | UnusablePhoto:
    """Decode one file to check that it is intact, and measure the statistics that are compared between photos."""
    place = resolve_file(folder, name)
    if isinstance(place, str):
        return UnusablePhoto(name, place)
    try:
        with large_photo_lock(place):
            found = describe(name, read_picture(place), options)
            return replace(found, file_bytes=place.stat().st_size) if isinstance(found, PhotoStats) else found
    except UnreadableError as err:
        return UnusablePhoto(name, str(err))


def describe(name: str, picture: DecodedPhoto, options: PhotoSettings) -> PhotoStats | UnusablePhoto:
    """Return a photo's metadata and image statistics; raise an UnreadableError for a part of a panorama."""
    image, exif = picture.image, picture.exif
    upright = upright_image(picture)
    panorama = is_panorama(picture, upright)
    turn = 0 if panorama else turn_deg(exif)  # rows of a panorama are latitudes
    size = image.size[::-1] if orientation(exif) >= 5 and not turn else image.size
    if min(size) < options.min_side_px:
        return UnusablePhoto(name, f"smaller than {options.min_side_px} px")
    opaque = opaque_pixels(image)
    if not opaque.any():
        return UnusablePhoto(name, "transparent all over")
    share = min(1.0, (options.max_megapixels * 1_000_000 / (size[0] * size[1])) ** 0.5)
    width, height = max(1, int(size[0] * share)), max(1, int(size[1] * share))
    photo = Photo(
        name=name,
        width=width,
        height=height,
        group=camera_name(exif),
        prior=None if panorama else exif_prior(exif, max(width, height)),
        needs_copy=(width, height) != size or not _is_read_by_colmap(picture),
        gps=gps_position(exif, xmp_entries(image, exif)),
        lossy=image.format in LOSSY,
        turn_deg=turn,
        notes=_notes(picture, size, (width, height), panorama=panorama),
        projection=EQUIRECTANGULAR if panorama else PERSPECTIVE,
        cut_out=not opaque.all(),
    )
    return measure_photo(photo if panorama else replace(photo, shown=_shown_frame(upright, photo)), upright)


def _is_read_by_colmap(picture: DecodedPhoto) -> bool:
    """Return whether COLMAP reads and writes the file as it is: 8 bits, opaque, not rotated and sRGB."""
    image = picture.image
    plain = image.mode in ("RGB", "L") and "transparency" not in image.info
    kept = plain and not picture.recolored and orientation(picture.exif) == 1
    return image.format in ("JPEG", "MPO", "PNG") and kept


def _notes(picture: DecodedPhoto, size: tuple[int, int], laid: tuple[int, int], *, panorama: bool) -> tuple[str, ...]:
    """Return notes for people on a file of several pictures, its colors, a photo scaled down, and a panorama."""
    many = f"its {picture.frames}" if picture.frames <= MOST_FRAMES else f"more than {MOST_FRAMES}"
    notes = [*([f"the largest of {many} pictures"] if picture.frames > 1 else []), *picture.notes]
    if laid != size:
        notes.append(f"scaled down from {size[0]} x {size[1]} to {laid[0]} x {laid[1]} pixels")
    if panorama:
        notes.append("a panorama of 360 x 180 degrees")
    return tuple(notes)


def _shown_frame(upright: Image.Image, photo: Photo) -> Frame | None:
    laid = rotate_to_sensor(upright, photo.turn_deg)
    frame = shown_part(laid)
    if frame is None or laid.size == (photo.width, photo.height):
        return frame
    x, y = photo.width / laid.width, photo.height / laid.height
    return round(frame[0] * x), round(frame[1] * y), round(frame[2] * x), round(frame[3] * y)


def group_by_camera(photos: Sequence[Photo], cameras: str) -> Iterator[Photo]:
    """Yield photos with their groups, in their order; photos of one group share one camera.

    A camera in COLMAP has one image size. Photos without an EXIF rotation are therefore turned to the more common
    orientation of their camera, and photos that still differ in size get different groups. Panoramas of one size form
    one group.

    Their groups are first the cameras named in EXIF. `cameras` is "auto", by EXIF and the size within bars; "single",
    one for all; "folder", one each; or "each", one per photo.
    """
    photos = _complete_panoramas(photos)
    sizes = Counter((_camera_key(photo, cameras), photo.width, photo.height) for photo in photos)
    grouped = []
    for photo in photos:
        key = _camera_key(photo, cameras)
        here, across = (sizes[key, *size] for size in ((photo.width, photo.height), (photo.height, photo.width)))
        is_minority = across > here or (across == here and photo.height > photo.width)
        laid = _rotate(photo) if across and is_minority and not photo.turn_deg else photo
        grouped.append(replace(laid, group=" ".join(filter(None, (f"{laid.width}x{laid.height}", key)))))
    yield from _split_by_shown_size(grouped) if cameras == "auto" else (replace(one, shown=None) for one in grouped)


def _complete_panoramas(photos: Sequence[Photo]) -> list[Photo]:
    """Return the photos; those of a size of which most are panoramas are panoramas, too."""
    # without metadata, a panorama is recognized by its borders, which may be a blank wall
    counts = Counter((photo.width, photo.height) for photo in photos)
    panoramas = Counter((photo.width, photo.height) for photo in photos if photo.projection == EQUIRECTANGULAR)
    sizes = {size for size, count in panoramas.items() if count > counts[size] / 2 and size[0] == 2 * size[1]}
    return [replace(one, projection=EQUIRECTANGULAR) if (one.width, one.height) in sizes else one for one in photos]


def with_one_zero(photos: Sequence[Photo]) -> list[Photo]:
    """Return the photos with altitudes from one zero: the user's file, else the more common one; others are dropped."""
    zeros = Counter(photo.gps.zero for photo in photos if photo.gps and photo.gps.altitude_m is not None)
    zero = FILE if FILE in zeros else TAKE_OFF if zeros[TAKE_OFF] > zeros[SEA_LEVEL] else SEA_LEVEL
    return [
        replace(photo, gps=replace(photo.gps, altitude_m=None, zero=zero, altitude_deviation_m=None))
        if photo.gps and photo.gps.zero != zero
        else photo
        for photo in photos
    ]


def split_by_given_camera(photos: Sequence[Photo], given: GivenCameras) -> list[Photo]:
    """Return the photos, with groups split where a calibration file gives their photos different cameras."""
    names: dict[str, set[str]] = {}
    for photo in photos:
        if name := given.camera_name(photo.name):
            names.setdefault(photo.group, set()).add(name)
    mixed = {group for group, cameras in names.items() if len(cameras) > 1}
    split = []
    for photo in photos:
        name = given.camera_name(photo.name) if photo.group in mixed else None
        split.append(replace(photo, group=f"{photo.group} by {name}") if name else photo)
    return split


def _split_by_shown_size(photos: Sequence[Photo]) -> list[Photo]:
    """Give letterboxed photos with different picture sizes groups of their own."""
    groups: dict[str, list[int]] = {}
    for place, photo in enumerate(photos):
        groups.setdefault(photo.group, []).append(place)
    split = list(photos)
    for places in groups.values():
        for place, photo in zip(places, unify_frames([photos[place] for place in places]), strict=True):
            inside = f"{photo.shown[2]}x{photo.shown[3]} in " if photo.shown else ""
            split[place] = replace(photo, group=inside + photo.group)
    return split


def _camera_key(photo: Photo, cameras: str) -> str:
    if photo.projection == EQUIRECTANGULAR:
        return EQUIRECTANGULAR
    return {
        "auto": photo.group,
        "single": "",
        "folder": PurePosixPath(photo.path).parent.as_posix(),
        "each": photo.path,
    }[cameras]


def _rotate(photo: Photo) -> Photo:
    """Rotate a photo by 90 degrees; by 270 degrees, only the principal point, near the middle, would be mirrored."""
    shown = photo.shown
    if shown is not None:
        left, top, width, height = shown
        shown = (top, photo.width - left - width, height, width)
    return replace(photo, width=photo.height, height=photo.width, turn_deg=90, needs_copy=True, shown=shown)
