"""Which photos share one camera."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import PurePosixPath

from sfm_app.types import Photo


def grouped(photos: Iterable[Photo], cameras: str) -> Iterator[Photo]:
    """Photos with their groups; those of one group share one camera.

    COLMAP's cameras have one size, so that photos of different sizes are never of one group.

    Args:
        photos: with the camera that EXIF names as their group.
        cameras: "auto": by EXIF; "single": one camera took all; "folder": one per folder; "each": one per photo.
    """
    for photo in photos:
        size = f"{photo.width}x{photo.height}"
        by = {
            "auto": photo.group,
            "single": "",
            "folder": PurePosixPath(photo.path).parent.as_posix(),
            "each": photo.path,
        }[cameras]
        yield replace(photo, group=" ".join(filter(None, (size, by))))
