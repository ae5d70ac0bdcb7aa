"""Cameras that the user gave in a calibration file."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from sfm_app.types.calibration import Calibration


@dataclass(frozen=True, slots=True)
class GivenCameras:
    """Contents of a calibration file; falsy where none was given."""

    cameras: Mapping[str, Calibration] = field(default_factory=dict)
    """By their name in the file. Width and height are 0 where the file does not say for which photos K holds."""
    camera_of: Mapping[str, str] = field(default_factory=dict)
    """Name of the camera by photo, where the file says so."""
    source: str = ""
    """Path and form of the file, for people."""
    digest: str = ""
    """Hash of what was read; empty where nothing was given."""

    def __bool__(self) -> bool:
        return bool(self.cameras)

    def camera_name(self, photo: str) -> str | None:
        """Return the name of the camera that the file gives a photo; None where it says nothing."""
        return self.camera_of.get(photo, photo if photo in self.cameras else None)
