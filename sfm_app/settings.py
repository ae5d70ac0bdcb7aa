"""Every option of the program: typed, with unit, range and one line of help; TOML in and out.

A section is a pydantic model; flags, help and the TOML file come from its fields. Presets are tables of values.
"""

import difflib
import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from sfm_app.errors import ConfigError
from sfm_app.files import read_text
from sfm_app.wording import parse_length, parse_point

CameraModelName = Literal[
    "auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_FISHEYE",
    "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "EQUIRECTANGULAR",
]  # fmt: skip
MarkerFamily = Literal[
    "auto", "apriltag-36h11", "apriltag-25h9", "apriltag-16h5", "aruco-4x4", "aruco-4x4-1000", "aruco-5x5",
    "aruco-5x5-1000", "aruco-6x6", "aruco-6x6-1000", "aruco-7x7", "aruco-7x7-1000", "aruco-original", "aruco-mip-36h12",
]  # fmt: skip
ConstraintForm = Literal["huang-faugeras", "frobenius", "trivedi", "polynomial"]
AS_NEEDED, MOST_LEVELS = 0, 4
"""Numbers of sizes of depth maps: 0 for as many as the photos need, and the most. Chosen by hand."""
MIN_DETOUR = 1.005
"""Least detour by the third of three places of a surface: with less, they are on a line but for the clicks. By hand."""
LOCAL_ADDRESS = re.compile(r"local:([1-9]\d{0,2})")
"""A cluster of so many processes of this machine."""
SCHEDULER_ADDRESS = re.compile(r"(?:[a-z]+://)?(?:[\w.-]+|\[[\da-fA-F:.]+\]):\d{1,5}")
"""Host, IPv4 or IPv6 address, and port, with Dask's name of a protocol or without."""


class Section(BaseModel):
    """One table of the settings file: frozen, and unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class PhotoSettings(Section):
    """Photos, and cameras that they share."""

    images: str = Field("", description="text file that names the photos to use, one per line; all where empty")
    masks: str = Field("", description="folder of masks, such as sub/a.jpg.png, or one for all; black is left out")
    positions: str = Field("", description="positions, as OpenDroneMap's geo.txt; if empty, geo.txt beside the photos")
    cameras: Literal["auto", "single", "folder", "each"] = Field(
        "auto",
        description="auto: same size and EXIF camera share one; single: all do; folder: those of a folder; each: none",
    )
    max_frames: int = Field(100, ge=2, le=2000, description="most frames of a video that are used")
    keep_low_quality: bool = Field(False, description="use copies, blurred photos and screenshots, too")
    max_megapixels: float = Field(64.0, ge=0.1, le=178, description="larger photos are scaled down to this size")
    min_side_px: int = Field(64, ge=16, le=4096, description="photos with a shorter side are left out, in pixels")


class MatchSettings(Section):
    """Features and matches."""

    features: str = Field("sift", description="name of the feature method (see `sfm-app plugins`)")
    max_image_size_px: int = Field(1600, ge=128, le=16384, description="longer side for features, in pixels")
    max_features: int = Field(8192, ge=100, le=100000, description="most features per photo")
    enlarge_below: int = Field(
        4000, ge=0, le=100000, description="photos with fewer features are searched again at twice their area or size"
    )
    max_ratio: float = Field(0.8, gt=0, le=1, description="largest ratio of the two nearest distances of SIFT; 1: any")
    pairs: Literal["auto", "all", "retrieval", "sequence"] = Field(
        "auto", description="all; retrieval: photos that look alike; sequence: neighbors; auto: all or retrieval"
    )
    neighbors: int = Field(30, ge=4, le=1000, description="photos to match with each one, where not all are")


class EpipolarSettings(Section):
    """Fundamental matrices, one per pair of photos."""

    estimator: str = Field("lev-ransac", description="estimator of fundamental matrices (see `sfm-app plugins`)")
    max_error_px: float = Field(1.5, gt=0, le=100, description="inlier threshold on the Sampson distance, in pixels")
    confidence: float = Field(0.9999, gt=0, lt=1, description="required probability that a sample is free of outliers")
    max_trials: int = Field(20000, ge=1, le=10_000_000, description="most minimal samples per pair")
    min_inliers: int = Field(16, ge=8, le=10000, description="a pair with fewer inliers is rejected")
    refit: Literal["auto", "eight-point", "sampson", "reprojection"] = Field(
        "auto", description="error that a last refit minimizes; auto: none"
    )


class CalibrationSettings(Section):
    """The camera matrix from the fundamental matrices."""

    calibrator: str = Field("zero-curves", description="name of the calibrator (see `sfm-app plugins`)")
    samples: int = Field(100, ge=10, le=10000, description="samples along a curve of `zero-curves-thesis`")
    constraint_form: ConstraintForm = Field(
        "huang-faugeras", description="constraint of the thesis's least squares: (5.8), (5.9), (5.11) or (5.25)"
    )
    lens: bool = Field(True, description="estimate the radial distortion of the lens")
    file: str = Field("", description="file or folder of known cameras, as of COLMAP or OpenCV; none where empty")
    keep: bool = Field(False, description="keep the cameras of the calibration file as they are")
    priors: str = Field("auto", description="guesses cameras from photos; auto: an installed one; none: only EXIF")
    deviation: float = Field(0.0, ge=0, le=1, description="deviation of the file's focals (a share); 0: exact")
    center_sigma: float = Field(0.15, gt=0, le=10, description="deviation of the center from the middle, in widths")


HypothesisName = Literal[
    "false-joins", "colmap-defaults", "other-focals", "other-cameras", "learned-cameras",
    "finer-features", "mapped-anew", "look-alikes", "global-mapper", "splits", "lens-families",
    "rolling-shutter",
]  # fmt: skip
FIRST_TRIAL = "first-pass"
"""Name of the trial that all hypotheses are compared with."""
HYPOTHESES: Mapping[HypothesisName, str] = {
    "false-joins": "leaving out the ambiguous pairs",
    "colmap-defaults": "COLMAP's default pipeline",
    "other-focals": "other focal lengths",
    "other-cameras": "other cameras for photos of one size (a zoom, or several devices)",
    "learned-cameras": "mapping again with the cameras of the model",
    "finer-features": "finer features for unplaced photos",
    "mapped-anew": "mapping all photos again",
    "look-alikes": "leaving out pairs of look-alikes",
    "global-mapper": "COLMAP's global mapper",
    "splits": "splitting a model whose parts contradict each other",
    "lens-families": "other lens models",
    "rolling-shutter": "a rolling shutter",
}
"""Hypotheses about the photos in words for people; up to "mapped-anew" those of `mapping.hypotheses`, the others within
a pass or after the last."""


class SceneSettings(Section):
    """Poses, sparse points and bundle adjustment."""

    mapper: Literal["auto", "incremental", "global"] = Field(
        "auto", description="incremental: photo after photo; global: all at once; auto: the better of both"
    )
    camera_model: CameraModelName = Field(
        "auto", description="COLMAP's camera model of the last adjustment, such as OPENCV; auto: by the photos"
    )
    max_init_pairs: int = Field(5, ge=1, le=100, description="most seed pairs that are tried")
    min_seed_angle_deg: float = Field(2.0, gt=0, le=90, description="least median angle of seeds, in degrees")
    part_photos: int = Field(
        0, ge=0, le=100_000, description="photos of a part, of larger sets: these are mapped in parts; 0: 150 above 400"
    )
    min_points: int = Field(30, ge=6, le=10000, description="a model with fewer points counts as failed")
    without: tuple[HypothesisName, ...] = Field((), description="hypotheses about the photos that are not tried")
    hypotheses_s: float = Field(3600.0, ge=0, description="time for hypotheses, in seconds")
    photo_rotation_deg: Literal["auto", 0, 90, 180, 270] = Field(
        "auto", description="clockwise rotation that makes most photos upright, in degrees"
    )

    def tries(self, hypothesis: HypothesisName) -> bool:
        """Return whether a hypothesis is not switched off."""
        return hypothesis not in self.without

    @field_validator("without", mode="before")
    @classmethod
    def split_names(cls, names: object) -> object:
        """Split a text at its commas."""
        return [name.strip() for name in names.split(",") if name.strip()] if isinstance(names, str) else names


class ScaleSettings(Section):
    """Real size: known lengths and places in the scene. Poses and depth do not depend on it."""

    distances: tuple[tuple[str, str, str], ...] = Field(
        (), description='known distances, each ["x,y,z", "x,y,z", "1.25m"]; measure in the report prints points'
    )
    level: tuple[tuple[str, str, str], ...] = Field(
        (), description='level surfaces, each three "x,y,z" counter-clockwise from above; the report prints them'
    )
    markers: str = Field("", description="side of the dark square of printed markers, such as 50mm; none where empty")
    marker_family: MarkerFamily = Field("auto", description="family of these markers; auto: the common ones")
    control_points: str = Field("", description="file of ground control points, as OpenDroneMap's gcp_list.txt")

    @field_validator("markers")
    @classmethod
    def check_side(cls, side: str) -> str:
        """Return a valid length; ValueError otherwise."""
        if side:
            parse_length(side)
        return side

    @field_validator("distances")
    @classmethod
    def check_distances(cls, distances: tuple[tuple[str, str, str], ...]) -> tuple[tuple[str, str, str], ...]:
        """Return valid distances; ValueError otherwise."""
        for first, second, length in distances:
            if parse_point(first) == parse_point(second):
                raise ValueError("a distance needs two different points")
            parse_length(length)
        return distances

    @field_validator("level")
    @classmethod
    def check_level(cls, level: tuple[tuple[str, str, str], ...]) -> tuple[tuple[str, str, str], ...]:
        """Return valid places; ValueError otherwise."""
        for places in level:
            a, b, c = map(parse_point, places)
            sides = sorted(map(math.dist, (a, b, c), (b, c, a)))
            if sides[0] + sides[1] <= MIN_DETOUR * sides[2]:
                raise ValueError("three places of a level surface must not lie on a line")
        return level


class DepthSettings(Section):
    """Depth maps."""

    method: str = Field("auto", description="see `sfm-app plugins`; auto: on the GPU if possible, else cpu")
    max_image_size_px: int = Field(1000, ge=64, le=16384, description="longer side of the depth maps, in pixels")
    levels: int = Field(
        AS_NEEDED,
        ge=AS_NEEDED,
        le=MOST_LEVELS,
        description="sizes of depth maps: smaller ones find more of plain walls; 0: 2 where needed",
    )
    neighbors: int = Field(4, ge=1, le=20, description="photos to match with each one")
    consistency: float = Field(0.01, gt=0, le=1, description="largest relative difference of depths that agree")
    min_agreeing: int = Field(1, ge=1, le=20, description="other photos that have to agree with a depth")
    drop_sky: bool = Field(True, description="remove depths in bright, even areas that are infinitely far; false: keep")


class MeshSettings(Section):
    """The surface through the depth maps."""

    watertight: bool = Field(False, description="close the surface where no photo sees it, by a guess, for printing")
    min_island: float = Field(0.0003, ge=0, le=1, description="parts with a smaller share of the triangles are dropped")
    max_error_edges: float = Field(0.15, ge=0, le=10, description="most that simplification moves it, in edges")
    max_image_size_px: int = Field(
        1600,
        ge=0,
        le=16384,
        description="longer side of the photos that refine the surface, in pixels; 0: no refinement",
    )
    faces: int = Field(200_000, ge=100, le=50_000_000, description="most triangles of the mesh or of a block")
    block_points: int = Field(4_000_000, ge=1000, le=1_000_000_000, description="most points in one mesh")


class TextureSettings(Section):
    """The texture of the surface."""

    max_atlas_px: int = Field(4096, ge=256, le=16384, description="longest side of a page of texture, in pixels")
    max_pages: int = Field(4, ge=1, le=64, description="most pages for each 400 000 triangles")
    unseen_faces: Literal["color", "cut"] = Field(
        "color", description="triangles that no photo sees: color: as their surroundings; cut: removed"
    )
    normal_map: bool = Field(False, description="keep the detail that simplification removes as a normal map")


class ClusterSettings(Section):
    """Dask's workers, on this machine or on others; results do not depend on them."""

    address: str = Field("", description="scheduler HOST:PORT of Dask, or local:N for N processes here; none if empty")
    wait_s: float = Field(60.0, gt=0, le=86400, description="seconds to wait for the scheduler and its workers")

    @field_validator("address")
    @classmethod
    def check_address(cls, address: str) -> str:
        """Return a valid address; ValueError otherwise."""
        form = LOCAL_ADDRESS if address.startswith("local:") else SCHEDULER_ADDRESS
        if address and not form.fullmatch(address):
            raise ValueError("should be HOST:PORT or local:N")
        return address


MOST_TOML_BYTES = 20_000
"""Largest settings file. One with every setting has a fifth; a megabyte of dots takes minutes to parse."""


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; ConfigError where it is not valid."""
    hint = "`sfm-app config` prints a valid one"
    try:
        return tomllib.loads(read_text(path, MOST_TOML_BYTES))
    except OSError as err:
        raise ConfigError(f"cannot read {path}: {err.strerror}") from err
    except RecursionError:
        raise ConfigError(f"{path} is no settings file: it is nested too deeply", hint=hint) from None
    except ValueError as err:  # not TOML, no text, too large, numbers of thousands of digits
        raise ConfigError(f"{path} is not a TOML file: {err}", hint=hint) from err


def toml_value(value: object) -> str:
    """Return a text, number, truth or list as TOML: JSON, but for letters that it escapes in pairs, and DEL."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_lines(section: BaseModel, table: str = "") -> Iterator[str]:
    """Yield the lines of a settings file, with the help of each setting as a comment; the top table has no name."""
    fields = type(section).model_fields
    tables = [name for name in fields if isinstance(getattr(section, name), BaseModel)]
    if table:
        yield f"\n# {(section.__doc__ or '').strip()}\n[{table}]"
    for name, info in fields.items():
        if name not in tables:
            yield f"# {info.description}\n{name} = {toml_value(getattr(section, name))}"
    for name in tables:
        yield from toml_lines(getattr(section, name), name)


MAX_PROBLEMS = 20
"""Most problems in an error message."""
Quality = Literal["draft", "normal", "high"]


class Settings(Section):
    """All settings of a run: from defaults, the quality preset, the TOML file and flags, in rising priority."""

    seed: int = Field(0, ge=0, lt=2**32, description="same seed, same result")
    workers: int = Field(0, ge=0, le=1024, description="parallel workers; 0: one per core")
    quality: Quality = Field(
        "normal", description="draft: do the photos suffice? normal: to look at; high: for archives"
    )
    max_memory_gb: float = Field(0.0, ge=0, le=4096, description="memory limit in GB; 0: four fifths of the machine's")
    plugins: bool = Field(True, description="load installed plug-ins; false: only the program's own methods")
    report: bool = Field(True, description="write OUT/report.html at the end of every run; false: do not")
    photos: PhotoSettings = PhotoSettings()
    matching: MatchSettings = MatchSettings()
    epipolar: EpipolarSettings = EpipolarSettings()
    calibration: CalibrationSettings = CalibrationSettings()
    scene: SceneSettings = SceneSettings()
    scale: ScaleSettings = ScaleSettings()
    depth: DepthSettings = DepthSettings()
    mesh: MeshSettings = MeshSettings()
    texture: TextureSettings = TextureSettings()
    cluster: ClusterSettings = ClusterSettings()

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], where: str = "settings") -> "Settings":
        """Check nested values on top of the preset that they name; a ConfigError lists the first few wrong ones.

        Examples:
            >>> from sfm_app import Settings
            >>> Settings.from_mapping({"quality": "draft", "depth": {"neighbors": 6}}).depth.neighbors
            6
            >>> Settings.from_mapping({"depth": {"neighbours": 6}})
            Traceback (most recent call last):
            sfm_app.errors.ConfigError: settings: unknown setting 'depth.neighbours'
        """
        preset = QUALITY_PRESETS.get(str(values.get("quality", "normal")), {})
        try:
            return cls.model_validate(merge_nested(preset, values))
        except ValidationError as err:
            errors = err.errors(include_url=False)
            problems = [_problem(dict(e)) for e in errors[:MAX_PROBLEMS]]
            more = f"; and {len(errors) - MAX_PROBLEMS} more" if len(errors) > MAX_PROBLEMS else ""
            raise ConfigError(
                f"{where}: " + "; ".join(text for text, _ in problems) + more,
                hint=next((hint for _, hint in problems if hint), "`sfm-app config` prints every setting"),
            ) from None

    @classmethod
    def from_toml(cls, path: Path, overrides: Mapping[str, Any] | None = None) -> "Settings":
        """Read a settings file, with some values overridden."""
        return cls.from_mapping(merge_nested(read_toml(path), overrides or {}), where=str(path))

    def to_toml(self) -> str:
        """Return every setting with its help as a comment; `from_toml` reads it back."""
        return "\n".join(toml_lines(self)) + "\n"


QUALITY_PRESETS: dict[str, dict[str, Any]] = {
    "draft": {
        "matching": {"max_features": 3072, "enlarge_below": 2000},
        "depth": {"max_image_size_px": 640, "neighbors": 3},
        "mesh": {"faces": 50_000, "max_image_size_px": 0},
        "texture": {"max_atlas_px": 2048, "max_pages": 1},
    },
    "normal": {},
    "high": {
        "matching": {"max_image_size_px": 3200, "max_features": 16384, "enlarge_below": 8000},
        "depth": {"max_image_size_px": 1400, "neighbors": 5},
        "mesh": {"faces": 1_000_000, "max_image_size_px": 3200},
        "texture": {"max_atlas_px": 8192},
    },
}


def merge_nested(low: Mapping[str, Any], high: Mapping[str, Any]) -> dict[str, Any]:
    """Return two nested mappings merged into one; values of `high` win."""
    result = dict(low)
    for key, value in high.items():
        below = result.get(key)
        result[key] = merge_nested(below, value) if isinstance(below, Mapping) and isinstance(value, Mapping) else value
    return result


def _problem(error: dict[str, Any]) -> tuple[str, str]:
    *table, key = [str(part) for part in error["loc"]] or ["settings"]
    name = ".".join((*table, key))
    if error["type"] != "extra_forbidden":
        return f"'{name}': {error['msg'].lower().removeprefix('value error, ')}, got {_abbreviate(error['input'])}", ""
    section: Any = Settings
    for part in table:
        section = section.model_fields[part].annotation
    close = difflib.get_close_matches(key, section.model_fields, n=1)
    return f"unknown setting {_abbreviate(name)}", f"did you mean '{'.'.join((*table, close[0]))}'?" if close else ""


def _abbreviate(value: object) -> str:
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # deeply nested values, numbers of thousands of digits
        text = f"a {type(value).__name__}"
    return text if len(text) <= 100 else f"{text[:100]}..."
