"""Which photos share one camera."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import PurePosixPath

from sfm_app.types import Photo

ON_END_DEG = 90
"""What a photo on end is taken to be turned by where nobody knows. The other way round only mirrors the place of the
optical centre, which lies near the middle."""


def grouped(photos: Sequence[Photo], cameras: str) -> Iterator[Photo]:
    """Photos with their groups; those of one group share one camera.

    COLMAP's cameras have one size. Photos taken on end are turned to lie as the others of their camera do; otherwise
    photos of different sizes are never of one group.

    Args:
        photos: with the camera that EXIF names as their group.
        cameras: "auto": by EXIF; "single": one camera took all; "folder": one per folder; "each": one per photo.
    """
    sizes = Counter((_maker(photo, cameras), photo.width, photo.height) for photo in photos)
    for photo in photos:
        maker = _maker(photo, cameras)
        here, across = (sizes[maker, *size] for size in ((photo.width, photo.height), (photo.height, photo.width)))
        on_end = across > here or (across == here and photo.height > photo.width)
        laid = _turned(photo) if across and on_end and not photo.turn_deg else photo
        yield replace(laid, group=" ".join(filter(None, (f"{laid.width}x{laid.height}", maker))))


def _maker(photo: Photo, cameras: str) -> str:
    return {
        "auto": photo.group,
        "single": "",
        "folder": PurePosixPath(photo.path).parent.as_posix(),
        "each": photo.path,
    }[cameras]


def _turned(photo: Photo) -> Photo:
    return replace(photo, width=photo.height, height=photo.width, turn_deg=ON_END_DEG, needs_copy=True)
