"""Read the cameras that a user knows, from the files of several programs."""

from sfm_app.camera_files.recognition import read_given_cameras

__all__ = ["read_given_cameras"]
