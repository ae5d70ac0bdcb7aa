"""Which photos share one camera."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import PurePosixPath

from sfm_app.photos.letterbox import unify_frames
from sfm_app.types import GivenCameras, Photo
from sfm_app.types.calibration import EQUIRECTANGULAR

PORTRAIT_TURN_DEG = 90
"""Rotation assumed for a portrait photo whose EXIF does not give one. The opposite rotation would only mirror the
optical center, which lies near the middle."""


def group_by_camera(photos: Sequence[Photo], cameras: str) -> Iterator[Photo]:
    """Yield photos with their groups, in their order; photos of one group share one camera.

    A camera in COLMAP has one image size. Photos without an EXIF rotation are therefore turned to the more common
    orientation of their camera; photos that still differ in size get different groups. With "auto", so do letterboxed
    photos whose pictures within the bars differ in size. Panoramas of one size always share one, with no other photos.

    Args:
        photos: their group is the camera named in EXIF.
        cameras: "auto": by EXIF; "single": one camera for all; "folder": one per folder; "each": one per photo.
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
    """Return the photos with groups of their own for those to which a calibration file gives different cameras.

    Args:
        photos: with the names that they have everywhere.
        given: contents of the file.
    """
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
