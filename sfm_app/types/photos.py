"""Photos, their features and their raw matches."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """Path inside the folder, with forward slashes, or another name where COLMAP cannot use that."""
    width: int
    """Width in pixels in the sensor's orientation, so that photos of one camera have one size."""
    height: int
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
    turn_deg: int = 0
    """Clockwise rotation that makes it upright: 0, 90, 180 or 270."""
    notes: tuple[str, ...] = ()
    """Remarks for the user about decoding."""
    shown: Frame | None = None
    """The picture inside bars of one color, in the sensor's orientation; None without bars."""
    mask: str = ""
    """Path of its mask inside the folder of masks; empty where it has none."""
    projection: str = "perspective"
    """"equirectangular" for a panorama, "perspective" for every other photo, also for fisheyes: matches show those."""
    time_s: float | None = None
    """Seconds from the start of its video; None for photos."""

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
    """One excluded file, and the reason."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class PhotoSet:
    """All usable photos of a folder, and every unusable file."""

    folder: Path
    photos: tuple[Photo, ...]
    unusable: tuple[UnusablePhoto, ...] = ()
    masks: Path | None = None

    @property
    def groups(self) -> dict[str, tuple[Photo, ...]]:
        """Photos by camera group, in order of first appearance."""
        groups: dict[str, list[Photo]] = {}
        for photo in self.photos:
            groups.setdefault(photo.group, []).append(photo)
        return {name: tuple(members) for name, members in groups.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Keypoints of one picture, the best first, with the data that their method needs to match them."""

    size: tuple[int, int]
    """Width and height of the picture in pixels."""
    keypoints: NDArray[np.float64]
    """(N, 2) x and y in pixels of the picture; the center of the top-left pixel is (0.5, 0.5)."""
    values: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Descriptors, scores and the like, with N rows each."""

    def __len__(self) -> int:
        return len(self.keypoints)

    def select(self, rows: NDArray[Any]) -> "Features":
        """Return the features in these rows."""
        return Features(self.size, self.keypoints[rows], {name: value[rows] for name, value in self.values.items()})


PairId = tuple[int, int]
"""(image id 1, image id 2) with id1 < id2, ids as in COLMAP's database."""


@dataclass(frozen=True, slots=True)
class MatchedImage:
    """A photo of the match graph."""

    id: int
    name: str
    group: str
    width: int
    height: int
    exif_focal_px: float | None = None
    gps: GpsPosition | None = None
    turn_deg: int = 0
    """Clockwise rotation that makes it upright, according to EXIF and its shape."""
    shown: Frame | None = None
    """The picture inside the bars; None without bars."""
    projection: str = "perspective"
    """"equirectangular" for a panorama, "perspective" for every other photo, also for fisheyes."""
    time_s: float | None = None
    """Seconds from the start of its video; None for photos."""


@dataclass(frozen=True, slots=True)
class MatchGraph:
    """Photos as nodes, raw matches as edges."""

    images: Mapping[int, MatchedImage]
    keypoints: Mapping[int, NDArray[np.float64]]
    """Per image id: (N, 2) pixels."""
    matches: Mapping[PairId, NDArray[np.uint32]]
    """Per pair: (M, 2) keypoint indices in image 1 and image 2."""

    @property
    def groups(self) -> dict[str, list[MatchedImage]]:
        """Photos by camera group, in the order of their ids."""
        groups: dict[str, list[MatchedImage]] = {}
        for _, image in sorted(self.images.items()):
            groups.setdefault(image.group, []).append(image)
        return groups

    def names(self, photos: Iterable[int]) -> list[str]:
        """Return the names of photos."""
        return [self.images[photo].name for photo in photos]

    def points(self, pair: PairId) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the matched points of one pair: x1, x2, each (M, 2) pixels."""
        rows = self.matches[pair]
        return self.keypoints[pair[0]][rows[:, 0]], self.keypoints[pair[1]][rows[:, 1]]
