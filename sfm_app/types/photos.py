"""What a folder of photos holds."""

from dataclasses import dataclass
from pathlib import Path

Frame = tuple[int, int, int, int]
"""Left, top, width and height of a part of a photo, in pixels."""


@dataclass(frozen=True, slots=True)
class GpsPosition:
    """Where a photo claims to be taken (WGS84)."""

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
    """What it goes by everywhere: its path inside the folder, with forward slashes, unless COLMAP cannot have that."""
    width: int
    """Width in pixels as it is laid out: as the sensor lies, so that photos of one camera have one size."""
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
    """Path inside the folder; the name where empty."""
    lossy: bool = True
    """Whether the file's format has lost something already."""
    turn_deg: int = 0
    """By how much it has to be turned clockwise to be upright: 0, 90, 180 or 270."""
    notes: tuple[str, ...] = ()
    """What people should know about how it is read."""
    shown: Frame | None = None
    """The picture within bars of one color, as it is laid out; None where all of it is picture."""
    mask: str = ""
    """Path of its mask inside the folder of masks; empty where all of it may be used."""

    @property
    def path(self) -> str:
        """Path inside the folder."""
        return self.original or self.name


@dataclass(frozen=True, slots=True)
class UnusablePhoto:
    """One file that was left out, and why."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class PhotoSet:
    """All usable photos of a folder, and every file that is not."""

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
