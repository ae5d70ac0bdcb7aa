"""Photos of a folder, usable or not."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

Frame = tuple[int, int, int, int]
"""Left, top, width and height of a part of a photo, in pixels."""


@dataclass(frozen=True, slots=True)
class GpsPosition:
    """Where a photo was taken according to EXIF (WGS84)."""

    latitude_deg: float
    """North of the equator, [-90, 90]."""
    longitude_deg: float
    """East of Greenwich, [-180, 180]."""
    altitude_m: float | None = None
    """Above sea level; None where unknown."""


@dataclass(frozen=True, slots=True)
class Photo:
    """One usable photo."""

    name: str
    """Its name everywhere: its path inside the folder, with forward slashes, unless COLMAP cannot use that."""
    width: int
    """Width in pixels as it is laid out: in the sensor's orientation, so that photos of one camera have one size."""
    height: int
    """Height in pixels."""
    group: str
    """Photos of one group share one camera."""
    exif_focal_px: float | None = None
    """Focal length that EXIF claims, in pixels of this photo; a hint, never trusted."""
    needs_copy: bool = False
    """True where COLMAP cannot read the file as it is (orientation, palette, 16 bit, format, size)."""
    gps: GpsPosition | None = None
    """Where EXIF claims it was taken; a hint, never trusted."""
    original: str = ""
    """Path inside the folder; empty where it is the name."""
    lossy: bool = True
    """Whether the file's format is lossy."""
    turn_deg: int = 0
    """Clockwise rotation that makes it upright: 0, 90, 180 or 270."""
    notes: tuple[str, ...] = ()
    """Remarks for the user about how it was read."""
    shown: Frame | None = None
    """The picture inside bars of one color, as it is laid out; None where there are no bars."""
    mask: str = ""
    """Path of its mask inside the folder of masks; empty where it has none."""
    projection: str = "perspective"
    """"equirectangular" for a panorama, "perspective" for every other photo, also for fisheyes: matches show those."""
    time_s: float | None = None
    """When it was taken, in seconds from the start of the video that it is a frame of; None for other photos."""

    @property
    def path(self) -> str:
        """Path inside the folder."""
        return self.original or self.name

    def to_dict(self) -> dict[str, Any]:
        """Return the photo as JSON values."""
        return {key: value for key, value in asdict(self).items() if key != "time_s" or value is not None}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Photo":
        """Return the photo from the values of `to_dict`."""
        gps, shown = values.get("gps"), values.get("shown")
        known = {"gps": GpsPosition(**gps) if gps else None, "shown": tuple(shown) if shown else None}
        return cls(**{**values, **known, "notes": tuple(values.get("notes", ()))})


@dataclass(frozen=True, slots=True)
class UnusablePhoto:
    """One file that was left out, and why."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class PhotoSet:
    """All usable photos of a folder, and every unusable file."""

    folder: Path
    photos: tuple[Photo, ...]
    unusable: tuple[UnusablePhoto, ...] = ()
    masks: Path | None = None
    """Folder of masks; None where none is given."""

    @property
    def groups(self) -> dict[str, tuple[Photo, ...]]:
        """Photos by camera group, in order of first appearance."""
        found: dict[str, list[Photo]] = {}
        for photo in self.photos:
            found.setdefault(photo.group, []).append(photo)
        return {name: tuple(members) for name, members in found.items()}
