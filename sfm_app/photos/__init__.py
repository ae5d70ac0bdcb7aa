"""Folders of photos as people have them: which files are photos, what is known about them, how they are laid out."""

from sfm_app.photos.copies import Glance, small_picture, without_copies
from sfm_app.photos.decode import LOSSY, Picture, UnreadableError, read_picture, upright
from sfm_app.photos.exif import camera_name, focal_px, gps_position, orientation
from sfm_app.photos.files import list_files, place_of
from sfm_app.photos.groups import grouped
from sfm_app.photos.layout import lay_out, stored_names
from sfm_app.photos.masks import (
    MASK_HINT,
    find_mask,
    lay_out_mask,
    list_masks,
    mask_place,
    read_used,
    save_used,
    unused_masks,
    without_masked,
)

__all__ = [
    "LOSSY",
    "MASK_HINT",
    "Glance",
    "Picture",
    "UnreadableError",
    "camera_name",
    "find_mask",
    "focal_px",
    "gps_position",
    "grouped",
    "lay_out",
    "lay_out_mask",
    "list_files",
    "list_masks",
    "mask_place",
    "orientation",
    "place_of",
    "read_picture",
    "read_used",
    "save_used",
    "small_picture",
    "stored_names",
    "unused_masks",
    "upright",
    "without_copies",
    "without_masked",
]
