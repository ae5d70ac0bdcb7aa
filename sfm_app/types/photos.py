"""Photos, their features and their raw matches."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.types.arrays import FloatArray

Frame = tuple[int, int, int, int]
"""Left, top, width and height of a part of a photo, in pixels."""


EXIF = "EXIF"
SEA_LEVEL, TAKE_OFF, FILE = "sea level", "take-off", "file"
"""What altitudes count from; that of the user's file is its own."""


@dataclass(frozen=True, slots=True)
class CameraPrior:
    """Claim of EXIF, of a plug-in or of the user about the camera of a photo, with standard deviations; never trusted.

    Pixels are those of the photo, in the orientation of its sensor.
    """

    source: str
    """Name for people, such as "EXIF"."""
    focal_px: float
    focal_deviation_px: float
    center_px: tuple[float, float] | None = None
    """Principal point; None for no claim."""
    center_deviation_px: float = 0.0
    """Of each coordinate."""
    k1: float | None = None
    """Radial distortion of COLMAP's SIMPLE_RADIAL; None for no claim."""
    k1_deviation: float = 0.0

    def __post_init__(self) -> None:
        deviations = [self.focal_deviation_px]
        if self.center_px is not None:
            deviations.append(self.center_deviation_px)
        if self.k1 is not None:
            deviations.append(self.k1_deviation)
        values = np.array([self.focal_px, *(self.center_px or ()), self.k1 or 0.0, *deviations], np.float64)
        if not (np.isfinite(values).all() and self.focal_px > 0.0 and min(deviations) > 0.0):
            raise ValueError("claims must be finite, and the focal length and every deviation > 0")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "CameraPrior":
        """Rebuild from `asdict`, also by way of JSON."""
        return cls(**{**values, "center_px": values["center_px"] and tuple(values["center_px"])})

    def move(self, left: float, top: float) -> "CameraPrior":
        """Return the claim in pixels that count from another origin."""
        center = self.center_px and (self.center_px[0] - left, self.center_px[1] - top)
        return replace(self, center_px=center)


def join_priors(priors: Sequence[CameraPrior]) -> CameraPrior | None:
    """Return the claim about a camera from those about its photos: medians, whose errors do not average out."""
    if not priors:
        return None
    focal_px, focal_deviation_px = _median([(one.focal_px, one.focal_deviation_px) for one in priors])
    joined = CameraPrior(priors[0].source, focal_px, focal_deviation_px)
    if centers := [(*one.center_px, one.center_deviation_px) for one in priors if one.center_px is not None]:
        (x, across), (y, down) = (_median([(one[axis], one[2]) for one in centers]) for axis in (0, 1))
        joined = replace(joined, center_px=(x, y), center_deviation_px=max(across, down))
    if terms := [(one.k1, one.k1_deviation) for one in priors if one.k1 is not None]:
        k1, k1_deviation = _median(terms)
        joined = replace(joined, k1=k1, k1_deviation=k1_deviation)
    return joined


def _median(claims: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the median of values, and the larger of their median deviation and of their own scatter."""
    values, deviations = np.array(claims, np.float64).T
    middle = float(np.median(values))
    scatter = 1.4826 * float(np.median(np.abs(values - middle)))  # the deviation of normal errors
    return middle, max(float(np.median(deviations)), scatter)


@dataclass(frozen=True, slots=True)
class GpsPosition:
    """Where a photo was taken according to EXIF, XMP or the user's file (WGS84)."""

    latitude_deg: float
    """North of the equator, [-90, 90]."""
    longitude_deg: float
    """East of Greenwich, [-180, 180]."""
    altitude_m: float | None = None
    """Above `zero`; None where unknown."""
    zero: str = SEA_LEVEL
    """What altitudes count from: `SEA_LEVEL`, `TAKE_OFF` or `FILE`. Those of one set of photos have the same."""
    deviation_m: float | None = None
    """Standard deviation of each horizontal coordinate; None for that of common receivers."""
    altitude_deviation_m: float | None = None


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
    prior: CameraPrior | None = None
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
    cut_out: bool = False
    """True where pixels of the file are transparent, which masks them."""
    named: str = ""
    """What the user calls it where several inputs were gathered: `pack.zip: a/b.jpg`."""

    @property
    def path(self) -> str:
        """Path inside the folder."""
        return self.original or self.name

    @property
    def label(self) -> str:
        """Name for people."""
        return self.named or self.path

    def to_dict(self) -> dict[str, Any]:
        """Return the photo as JSON values."""
        return {key: value for key, value in asdict(self).items() if key != "time_s" or value is not None}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Photo":
        """Return the photo from the values of `to_dict`; entries of other names are left out."""
        gps, shown = values.get("gps"), values.get("shown")
        known: dict[str, Any] = {"gps": GpsPosition(**gps) if gps else None, "shown": tuple(shown) if shown else None}
        known["prior"] = CameraPrior.from_dict(values["prior"]) if values.get("prior") else None
        same = {one.name: values[one.name] for one in fields(cls) if one.name in values}
        return cls(**{**same, **known, "notes": tuple(values.get("notes", ()))})


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
    """The user's folder of masks."""

    @property
    def has_masks(self) -> bool:
        """Whether all photos are laid out with a mask, by files or by transparent pixels of some."""
        return self.masks is not None or any(photo.cut_out for photo in self.photos)

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
    keypoints: FloatArray
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
    prior: CameraPrior | None = None
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
    keypoints: Mapping[int, FloatArray]
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

    def with_priors(self, priors: Mapping[str, CameraPrior]) -> "MatchGraph":
        """Return the graph with claims about some cameras, by name of the photo, in place of EXIF's."""
        if not priors:
            return self
        images = {key: replace(one, prior=priors.get(one.name, one.prior)) for key, one in self.images.items()}
        return replace(self, images=images)

    def names(self, photos: Iterable[int]) -> list[str]:
        """Return the names of photos."""
        return [self.images[photo].name for photo in photos]

    def points(self, pair: PairId) -> tuple[FloatArray, FloatArray]:
        """Return the matched points of one pair: x1, x2, each (M, 2) pixels."""
        rows = self.matches[pair]
        return self.keypoints[pair[0]][rows[:, 0]], self.keypoints[pair[1]][rows[:, 1]]
