"""Read and write masks, which mark the usable pixels of a photo, in COLMAP's naming and format.

The mask of `sub/a.jpg` is `sub/a.jpg.png`, `sub/a.png` or `sub/a_mask.png` in a separate folder, also as JPEG; black or
transparent pixels are not used. A mask belongs to the upright photo, as displayed. A single file without the name of a
photo is the mask of all.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from sfm_app.errors import InputError
from sfm_app.photos import decode
from sfm_app.photos.files import list_files, resolve_file
from sfm_app.types import Photo, UnusablePhoto
from sfm_app.types.arrays import BoolArray

ENDING = ".png"
MASK_HINT = (
    "the mask of sub/a.jpg is sub/a.jpg.png, sub/a.png or sub/a_mask.png in the folder of masks, of the shape of the "
    "photo; a single file masks all photos"
)
ALL_BLACK = "its mask is all black"
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
SPELLINGS = ("{}", "{}_mask", "{}-mask", "{}.mask", "mask_{}", "mask-{}")
NEAR_BLACK = 64
"""Level below which white of a mask counts as a label, and a quarter of which still counts as black otherwise.

JPEG makes a black area beside a white one up to 60 levels brighter. By hand.
"""


def split_mask_path(masks: str) -> tuple[Path, str]:
    """Return the folder of masks, and the name of the mask of all photos where a file is given."""
    path = Path(masks)
    return (path.resolve().parent, path.resolve().name) if path.is_file() else (path, "")


def list_masks(masks: str, photos: Path, out: Path) -> list[str]:
    """Return the files below the folder of masks, or the given one; raise an InputError if it cannot be used."""
    folder, name = split_mask_path(masks)
    if name:
        return [name]
    if not folder.is_dir():
        raise InputError(f"no such folder of masks: {masks}", hint=MASK_HINT)
    if folder.resolve() == photos.resolve():
        raise InputError(f"the masks lie among the photos in {photos}", hint="give the masks a folder of their own")
    return list_files(folder, out, (photos,))


def assign_masks(photos: Sequence[Photo], names: Collection[str], *, for_all: bool = False) -> list[Photo]:
    """Return the photos with their masks, empty without; one of `for_all`, or alone in its folder, masks all."""
    visible = {name for name in names if not PurePosixPath(name).name.startswith(".")}
    assigned = [replace(photo, mask=find_mask(photo.path, visible)) for photo in photos]
    is_alone = len(visible) == 1 and "/" not in "".join(visible) and not any(photo.mask for photo in assigned)
    return [replace(photo, mask=min(visible)) for photo in photos] if for_all or is_alone else assigned


def find_mask(path: str, names: Collection[str]) -> str:
    """Return the name of the mask of a photo; empty if there is none."""
    place = PurePosixPath(path)
    bases = [spelling.format(base) for spelling in SPELLINGS for base in (place.name, place.stem)]
    spelled = (str(place.with_name(base + suffix)) for suffix in SUFFIXES for base in bases)
    return next((name for name in spelled if name in names), "")


def check_mask(photo: Photo, folder: Path, masks: Path) -> Photo | UnusablePhoto:
    """Return the photo, unusable if nothing of it is left; raise an InputError if its mask cannot be used."""
    if not photo.mask or usable_pixels(photo, folder, masks).any():
        return photo
    return UnusablePhoto(photo.label, ALL_BLACK)


def unused_masks(names: Sequence[str], photos: Sequence[Photo]) -> list[str]:
    """Return the files in the folder of masks that belong to no photo; hidden files are ignored."""
    used = {photo.mask for photo in photos}
    return [name for name in names if name not in used and not PurePosixPath(name).name.startswith(".")]


def lay_out_mask(photo: Photo, folder: Path, masks: Path | None, target: Path) -> bool:
    """Write the mask of a laid-out photo, all white without one, and return whether it hides anything."""
    used = usable_pixels(photo, folder, masks)  # COLMAP skips photos without a mask
    save_mask(target, photo.name, used)
    return not used.all()


def usable_pixels(photo: Photo, folder: Path, masks: Path | None) -> BoolArray:
    """Return the (H, W) pixels of a laid-out photo that its mask and its transparency leave."""
    used = np.full((photo.height, photo.width), True)
    if photo.mask and masks is not None:
        used &= _load_fitted_mask(photo, folder, masks)
    return used & _load_opaque(photo, folder) if photo.cut_out else used


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
            raise decode.UnreadableError(place)
        picture = decode.read_picture(place)
        mask = decode.undo_exif_orientation(_binarize(picture.image), decode.orientation(picture.exif))
        size = (photo.height, photo.width) if photo.turn_deg in (90, 270) else (photo.width, photo.height)
        if not _has_same_aspect(mask.size, size):
            mask = _orient_mask(photo, size, mask, folder)
    except decode.UnreadableError as err:
        raise InputError(f"the mask {photo.mask} cannot be used: {err}", hint=MASK_HINT) from err
    fitted = mask if mask.size == size else mask.resize(size, Image.Resampling.NEAREST)
    return np.asarray(decode.rotate_to_sensor(fitted, photo.turn_deg)) > 0


def _load_opaque(photo: Photo, folder: Path) -> BoolArray:
    """Return the (H, W) opaque pixels of the laid-out photo."""
    source = resolve_file(folder, photo.path)
    if isinstance(source, str):
        raise InputError(f"{photo.label} has changed while it was read: {source}")
    picture = decode.read_picture(source)
    opaque = decode.undo_exif_orientation(
        Image.fromarray(decode.opaque_pixels(picture.image)), decode.orientation(picture.exif)
    )
    upright = (photo.height, photo.width) if photo.turn_deg in (90, 270) else (photo.width, photo.height)
    return np.asarray(decode.rotate_to_sensor(opaque.resize(upright, Image.Resampling.NEAREST), photo.turn_deg))


def _orient_mask(photo: Photo, size: tuple[int, int], mask: Image.Image, folder: Path) -> Image.Image:
    """Apply the photo's EXIF orientation to a mask that was painted on the pixels as stored in the file."""
    if _has_same_aspect(mask.size[::-1], size):
        source = resolve_file(folder, photo.path)
        stored = decode.orientation(decode.read_picture(source).exif) if isinstance(source, Path) else 1
        if stored >= 5:  # these swap width and height
            return decode.undo_exif_orientation(mask, stored)
    width, height = mask.size
    raise decode.UnreadableError(f"it has {width} x {height} pixels, its photo {size[0]} x {size[1]}")


def _has_same_aspect(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether two sizes have the same aspect ratio, to within a pixel of the smaller one."""
    return abs(one[0] * other[1] - one[1] * other[0]) <= max(*one, *other)


def _binarize(image: Image.Image) -> Image.Image:
    """Return white where any channel is brighter than nearly black, and the pixel is opaque."""
    if image.mode.startswith("I") or image.mode == "F":
        levels = np.asarray(image)
        opaque = np.full(levels.shape, True)
    else:
        plain = image.convert("RGB") if image.mode in ("CMYK", "YCbCr", "LAB", "HSV") else image
        channels = np.asarray(plain.convert("RGBA"))
        levels, opaque = channels[..., :3].max(axis=2), channels[..., 3] >= NEAR_BLACK
    brightest = float(levels.max())
    is_labels = brightest < NEAR_BLACK and image.format not in decode.LOSSY  # 0 and 1, say
    return _black_and_white((levels > (0.0 if is_labels else max(brightest, NEAR_BLACK) / 4.0)) & opaque)


def _black_and_white(used: BoolArray) -> Image.Image:
    return Image.fromarray(np.where(used, np.uint8(255), np.uint8(0)))
