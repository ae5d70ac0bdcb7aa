"""Folders of photos, and videos, as people have them: which files and frames are photos, and what is known."""

from sfm_app.photos.choosing import Choice, choose
from sfm_app.photos.containers import head_of, is_video
from sfm_app.photos.copies import Glance, small_picture, without_copies
from sfm_app.photos.decode import LOSSY, Picture, UnreadableError, read_picture, upright
from sfm_app.photos.exif import camera_name, focal_px, gps_position, orientation
from sfm_app.photos.files import list_files, place_of
from sfm_app.photos.following import Follower, Look
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
from sfm_app.photos.video import opened

__all__ = [
    "LOSSY",
    "MASK_HINT",
    "Choice",
    "Follower",
    "Glance",
    "Look",
    "Picture",
    "UnreadableError",
    "camera_name",
    "choose",
    "find_mask",
    "focal_px",
    "gps_position",
    "grouped",
    "head_of",
    "is_video",
    "lay_out",
    "lay_out_mask",
    "list_files",
    "list_masks",
    "mask_place",
    "opened",
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
