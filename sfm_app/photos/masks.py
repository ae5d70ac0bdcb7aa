"""Read and write masks, which mark the usable pixels of a photo, in COLMAP's naming and format.

The mask of `sub/a.jpg` is `sub/a.jpg.png` or `sub/a.png` in a separate folder; black or transparent pixels are not
used. A mask belongs to the upright photo, as displayed.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from sfm_app.errors import InputError
from sfm_app.photos.decode import (
    UnreadableError,
    opaque_pixels,
    orientation,
    read_picture,
    rotate_to_sensor,
    undo_exif_orientation,
)
from sfm_app.photos.files import list_files, resolve_file
from sfm_app.types import Photo, UnusablePhoto
from sfm_app.types.arrays import BoolArray

ENDING = ".png"
MASK_HINT = "the mask of sub/a.jpg is sub/a.jpg.png or sub/a.png in the folder of masks, of the size of the photo"


def list_masks(masks: Path, photos: Path, out: Path) -> list[str]:
    """Return the files below the folder of masks, as `list_files` does; raise an InputError if it cannot be used."""
    if not masks.is_dir():
        problem = "not a folder" if masks.exists() else "no such folder"
        raise InputError(f"{problem} of masks: {masks}", hint=MASK_HINT)
    if masks.resolve() == photos.resolve():
        raise InputError(f"the masks lie among the photos in {photos}", hint="give the masks a folder of their own")
    return list_files(masks, out, (photos,))


def find_mask(photo: Photo, folder: Path, masks: Path) -> Photo | UnusablePhoto:
    """Return the photo with its mask, if any, unusable if that is all black; InputError if the mask cannot be used."""
    names = f"{photo.path}{ENDING}", str(PurePosixPath(photo.path).with_suffix(ENDING))
    name = next((name for name in names if os.path.lexists(masks / name)), "")
    if not name:
        return photo
    masked = replace(photo, mask=name)
    if not np.any(_load_fitted_mask(masked, folder, masks)):
        return UnusablePhoto(photo.path, f"its mask {name} is all black")
    return masked


def unused_masks(names: Sequence[str], photos: Sequence[Photo]) -> list[str]:
    """Return the files in the folder of masks that belong to no photo; hidden files are ignored."""
    used = {photo.mask for photo in photos}
    return [name for name in names if name not in used and not PurePosixPath(name).name.startswith(".")]


def lay_out_mask(photo: Photo, folder: Path, masks: Path | None, target: Path) -> None:
    """Write the mask of a laid-out photo; all white without one, since COLMAP skips photos without a mask."""
    used = np.full((photo.height, photo.width), True)
    if photo.mask and masks is not None:
        used &= _load_fitted_mask(photo, folder, masks)
    if photo.cut_out:
        used &= _load_opaque(photo, folder)
    save_mask(target, photo.name, used)


def mask_path(target: Path, name: str) -> Path:
    """Return the path of the staged mask of a photo."""
    return target / f"{name}{ENDING}"


def save_mask(target: Path, name: str, used: BoolArray) -> None:
    """Write the (H, W) usable pixels of a laid-out photo as a black and white mask."""
    place = mask_path(target, name)
    place.parent.mkdir(parents=True, exist_ok=True)
    _black_and_white(used).save(place, "PNG", compress_level=1)


def read_mask(target: Path, name: str) -> BoolArray:
    """Read the (H, W) mask that `save_mask` wrote; raise an OSError if it cannot be read."""
    with Image.open(mask_path(target, name)) as image:
        return np.asarray(image) > 0


def _load_fitted_mask(photo: Photo, folder: Path, masks: Path) -> BoolArray:
    """Return the (H, W) usable pixels of the laid-out photo."""
    try:
        place = resolve_file(masks, photo.mask)
        if isinstance(place, str):
            raise UnreadableError(place)
        picture = read_picture(place)
        mask = undo_exif_orientation(_binarize(picture.image), orientation(picture.exif))
        size = (photo.height, photo.width) if photo.turn_deg in (90, 270) else (photo.width, photo.height)
        if not _has_same_aspect(mask.size, size):
            mask = _orient_mask(photo, size, mask, folder)
    except UnreadableError as err:
        raise InputError(f"the mask {photo.mask} cannot be used: {err}", hint=MASK_HINT) from err
    fitted = mask if mask.size == size else mask.resize(size, Image.Resampling.NEAREST)
    return np.asarray(rotate_to_sensor(fitted, photo.turn_deg)) > 0


def _load_opaque(photo: Photo, folder: Path) -> BoolArray:
    """Return the (H, W) opaque pixels of the laid-out photo."""
    source = resolve_file(folder, photo.path)
    if isinstance(source, str):
        raise InputError(f"{photo.path} has changed while it was read: {source}")
    picture = read_picture(source)
    opaque = undo_exif_orientation(Image.fromarray(opaque_pixels(picture.image)), orientation(picture.exif))
    upright = (photo.height, photo.width) if photo.turn_deg in (90, 270) else (photo.width, photo.height)
    return np.asarray(rotate_to_sensor(opaque.resize(upright, Image.Resampling.NEAREST), photo.turn_deg))


def _orient_mask(photo: Photo, size: tuple[int, int], mask: Image.Image, folder: Path) -> Image.Image:
    """Apply the photo's EXIF orientation to a mask that was painted on the pixels as stored in the file."""
    if _has_same_aspect(mask.size[::-1], size):
        source = resolve_file(folder, photo.path)
        stored = orientation(read_picture(source).exif) if isinstance(source, Path) else 1
        if stored >= 5:  # these swap width and height
            return undo_exif_orientation(mask, stored)
    width, height = mask.size
    raise UnreadableError(f"it has {width} x {height} pixels, its photo {size[0]} x {size[1]}")


def _has_same_aspect(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether two sizes have the same aspect ratio, to within a pixel of the smaller one."""
    return abs(one[0] * other[1] - one[1] * other[0]) <= max(*one, *other)


def _binarize(image: Image.Image) -> Image.Image:
    """Return white where any channel is nonzero and the pixel is opaque."""
    if image.mode.startswith("I") or image.mode == "F":
        used = np.asarray(image) != 0
    else:
        plain = image.convert("RGB") if image.mode in ("CMYK", "YCbCr", "LAB", "HSV") else image
        channels = np.asarray(plain.convert("RGBA"))
        used = channels[..., :3].any(axis=2) & (channels[..., 3] > 0)
    return _black_and_white(used)


def _black_and_white(used: BoolArray) -> Image.Image:
    return Image.fromarray(np.where(used, np.uint8(255), np.uint8(0)))
