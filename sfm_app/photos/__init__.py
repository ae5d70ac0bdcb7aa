"""Folders of photos as people have them: which files are photos, what is known about them, how they are laid out."""

from sfm_app.photos.copies import Glance, small_picture, without_copies
from sfm_app.photos.decode import LOSSY, MOST_FRAMES, Picture, UnreadableError, read_picture, upright
from sfm_app.photos.exif import camera_name, focal_px, gps_position, orientation
from sfm_app.photos.files import list_files, place_of
from sfm_app.photos.groups import grouped
from sfm_app.photos.layout import lay_out, stored_names

__all__ = [
    "LOSSY",
    "MOST_FRAMES",
    "Glance",
    "Picture",
    "UnreadableError",
    "camera_name",
    "focal_px",
    "gps_position",
    "grouped",
    "lay_out",
    "list_files",
    "orientation",
    "place_of",
    "read_picture",
    "small_picture",
    "stored_names",
    "upright",
    "without_copies",
]
