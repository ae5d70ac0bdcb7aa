"""Read and write masks, which mark the usable pixels of a photo, in COLMAP's naming and format.

The mask of `sub/a.jpg` is `sub/a.jpg.png` or `sub/a.png` in a separate folder; black or transparent pixels are not
used. A mask belongs to the upright photo, as displayed.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.errors import InputError
from sfm_app.photos.decode import UnreadableError, orientation, read_picture, rotate_to_sensor, undo_exif_orientation
from sfm_app.photos.files import list_files, resolve_file
from sfm_app.types import Photo, UnusablePhoto
from sfm_app.types.arrays import BoolArray

ENDING = ".png"
MASK_HINT = "the mask of sub/a.jpg is sub/a.jpg.png or sub/a.png in the folder of masks, of the size of the photo"
WHITE = 255
FIRST_SIDEWAYS = 5
"""EXIF orientations from this value on swap width and height."""


def list_masks(masks: Path, photos: Path, out: Path) -> list[str]:
    """Return the names of all files below the folder of masks, as `list_files` does, without photos and output.

    Args:
        masks: folder of the masks.
        photos: folder of the photos.
        out: output folder; may lie inside the folder of masks.

    Raises:
        InputError: there is no such folder, or it is also the folder of the photos.
    """
    if not masks.is_dir():
        what = "not a folder" if masks.exists() else "no such folder"
        raise InputError(f"{what} of masks: {masks}", hint=MASK_HINT)
    if masks.resolve() == photos.resolve():
        raise InputError(f"the masks lie among the photos in {photos}", hint="give the masks a folder of their own")
    return list_files(masks, out, closed=(photos,))


def find_mask(photo: Photo, folder: Path, masks: Path) -> Photo | UnusablePhoto:
    """Return the photo with its mask, if it has one; an unusable photo if everything is masked.

    Args:
        photo: as it was read.
        folder: of the photos.
        masks: folder of the masks.

    Raises:
        InputError: the mask cannot be used.
    """
    names = f"{photo.path}{ENDING}", str(PurePosixPath(photo.path).with_suffix(ENDING))
    name = next((name for name in names if os.path.lexists(masks / name)), "")
    if not name:
        return photo
    found = replace(photo, mask=name)
    if not np.any(_load_fitted_mask(found, folder, masks)):
        return UnusablePhoto(photo.path, f"its mask {name} is all black")
    return found


def unused_masks(names: Sequence[str], photos: Sequence[Photo]) -> list[str]:
    """Return the files in the folder of masks that belong to no photo; hidden files are ignored.

    Args:
        names: from `list_masks`.
        photos: those of the run, with their masks.
    """
    used = {photo.mask for photo in photos}
    return [name for name in names if name not in used and not PurePosixPath(name).name.startswith(".")]


def lay_out_mask(photo: Photo, folder: Path, masks: Path, target: Path) -> None:
    """Write the mask of a photo, in the orientation of the laid-out photo; all white if it has none.

    COLMAP skips photos without a mask as soon as it is given any masks.

    Args:
        photo: with its mask, if it has one.
        folder: of the photos.
        masks: folder of the masks.
        target: folder to write to.

    Raises:
        InputError: as `find_mask`.
        OSError: the target cannot be written.
    """
    used = _load_fitted_mask(photo, folder, masks) if photo.mask else np.full((photo.height, photo.width), True)
    save_mask(target, photo.name, used)


def mask_path(target: Path, name: str) -> Path:
    """Return the path of the staged mask of a photo.

    Args:
        target: folder of the staged masks.
        name: of the photo.
    """
    return target / f"{name}{ENDING}"


def save_mask(target: Path, name: str, used: BoolArray) -> None:
    """Write the usable pixels of a photo as a black and white mask.

    Args:
        target: folder of the staged masks.
        name: of the photo.
        used: (H, W), in the orientation of the laid-out photo.
    """
    place = mask_path(target, name)
    place.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(_to_uint8(used)).save(place, "PNG", compress_level=1)


def read_mask(target: Path, name: str) -> BoolArray:
    """Read the (H, W) mask that `save_mask` wrote.

    Args:
        target: folder of the staged masks.
        name: of the photo.

    Raises:
        OSError: it cannot be read.
    """
    with Image.open(mask_path(target, name)) as image:
        return np.asarray(image) > 0


def fill_masked(pixels: NDArray[np.uint8], used: BoolArray) -> NDArray[np.uint8]:
    """Return a photo whose masked pixels take the color of the nearest usable pixel.

    This keeps masked colors out of interpolation and downscaling.

    Args:
        pixels: (H, W, 3) RGB.
        used: (H, W), whether each pixel may be used.
    """
    if used.all() or not used.any():
        return pixels
    hidden = (~used).view(np.uint8)
    _, nearest = cv2.distanceTransformWithLabels(hidden, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    seeds = np.flatnonzero(used)
    place = np.zeros(len(seeds) + 1, np.int64)  # labels count from 1
    place[nearest.ravel()[seeds]] = seeds
    return np.asarray(pixels.reshape(-1, 3)[place[nearest]])


def _load_fitted_mask(photo: Photo, folder: Path, masks: Path) -> BoolArray:
    """Return (H, W) usable pixels of the photo by its mask, in the orientation of the laid-out photo."""
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


def _orient_mask(photo: Photo, size: tuple[int, int], mask: Image.Image, folder: Path) -> Image.Image:
    """Apply the photo's EXIF orientation to a mask that was painted on the pixels as stored in the file."""
    if _has_same_aspect(mask.size[::-1], size):
        source = resolve_file(folder, photo.path)
        turned = orientation(read_picture(source).exif) if isinstance(source, Path) else 1
        if turned >= FIRST_SIDEWAYS:
            return undo_exif_orientation(mask, turned)
    width, height = mask.size
    raise UnreadableError(f"it has {width} x {height} pixels, its photo {size[0]} x {size[1]}")


def _has_same_aspect(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether two sizes have the same aspect ratio, to within a pixel of the smaller one."""
    return abs(one[0] * other[1] - one[1] * other[0]) <= max(*one, *other)


def _binarize(image: Image.Image) -> Image.Image:
    """Return white where any channel is nonzero and the pixel is not transparent."""
    if image.mode.startswith("I") or image.mode == "F":
        used = np.asarray(image) != 0
    elif image.mode in ("1", "L") and "transparency" not in image.info:
        used = np.asarray(image.convert("L")) > 0
    elif image.mode in ("RGB", "CMYK", "YCbCr", "LAB", "HSV") and "transparency" not in image.info:
        used = np.asarray(image.convert("RGB")).any(axis=2)
    else:
        channels = np.asarray(image.convert("RGBA"))
        used = channels[..., :3].any(axis=2) & (channels[..., 3] > 0)
    return Image.fromarray(_to_uint8(used))


def _to_uint8(used: BoolArray) -> NDArray[np.uint8]:
    return np.where(used, np.uint8(WHITE), np.uint8(0))
