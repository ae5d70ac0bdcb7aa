"""Read folders of photos and videos: which files and frames are usable photos, and their metadata."""

from sfm_app.photos.decode import UnreadableError, read_picture, upright_image
from sfm_app.photos.files import is_video, list_files, read_head, resolve_file
from sfm_app.photos.masks import (
    MASK_HINT,
    fill_masked,
    find_mask,
    lay_out_mask,
    list_masks,
    mask_path,
    read_mask,
    save_mask,
    unused_masks,
)
from sfm_app.photos.probe import group_by_camera, read_photo, split_by_given_camera
from sfm_app.photos.selection import PhotoStats, drop_duplicates, drop_unusable, read_stats, write_stats
from sfm_app.photos.source import Source, assign_names, is_laid_out, lay_out, read_source
from sfm_app.photos.video import CornerTracker, TrackedFrame, open_video, select_keyframes

__all__ = [
    "MASK_HINT",
    "CornerTracker",
    "PhotoStats",
    "Source",
    "TrackedFrame",
    "UnreadableError",
    "assign_names",
    "drop_duplicates",
    "drop_unusable",
    "fill_masked",
    "find_mask",
    "group_by_camera",
    "is_laid_out",
    "is_video",
    "lay_out",
    "lay_out_mask",
    "list_files",
    "list_masks",
    "mask_path",
    "open_video",
    "read_head",
    "read_mask",
    "read_photo",
    "read_picture",
    "read_source",
    "read_stats",
    "resolve_file",
    "save_mask",
    "select_keyframes",
    "split_by_given_camera",
    "unused_masks",
    "upright_image",
    "write_stats",
]
