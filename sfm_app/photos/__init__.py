"""Read folders of photos and videos: which files and frames are usable photos, and their metadata."""

from sfm_app.photos.camera_groups import grouped
from sfm_app.photos.decode import UnreadableError, read_picture, upright
from sfm_app.photos.duplicates import without_copies
from sfm_app.photos.files import list_files, place_of
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
from sfm_app.photos.probe import read_photo
from sfm_app.photos.quality_filter import screened
from sfm_app.photos.source import Source, read_source
from sfm_app.photos.staging import lay_out, stored_names
from sfm_app.photos.thumbnail_stats import Glance
from sfm_app.photos.video.feature_tracking import Follower, TrackedFrame
from sfm_app.photos.video.keyframe_selection import choose
from sfm_app.photos.video.video_formats import head_of, is_video
from sfm_app.photos.video.video_reader import opened

__all__ = [
    "MASK_HINT",
    "Follower",
    "Glance",
    "Source",
    "TrackedFrame",
    "UnreadableError",
    "choose",
    "find_mask",
    "grouped",
    "head_of",
    "is_video",
    "lay_out",
    "lay_out_mask",
    "list_files",
    "list_masks",
    "mask_place",
    "opened",
    "place_of",
    "read_photo",
    "read_picture",
    "read_source",
    "read_used",
    "save_used",
    "screened",
    "stored_names",
    "unused_masks",
    "upright",
    "without_copies",
    "without_masked",
]
