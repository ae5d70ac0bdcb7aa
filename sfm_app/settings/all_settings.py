"""All settings of a run, from defaults, the quality preset, the TOML file and flags, in rising priority."""

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from sfm_app.errors import ConfigError
from sfm_app.settings.tables import (
    CalibrationSettings,
    ClusterSettings,
    DepthSettings,
    EpipolarSettings,
    MatchSettings,
    MeshSettings,
    PhotoSettings,
    ScaleSettings,
    SceneSettings,
    Section,
    TextureSettings,
)
from sfm_app.settings.toml_files import read_toml, toml_lines

MAX_PROBLEMS, MAX_VALUE_CHARS = 20, 100
"""Most problems that an error lists, and most characters of a wrong value that it shows."""

Quality = Literal["draft", "normal", "high"]


class Settings(Section):
    """All settings of a run."""

    seed: int = Field(0, ge=0, lt=2**32, description="same seed, same result")
    workers: int = Field(0, ge=0, le=1024, description="parallel workers; 0: one per core")
    quality: Quality = Field("normal", description="preset for image sizes and mesh resolution")
    max_memory_gb: float = Field(
        0.0, ge=0, le=4096, description="most memory that is used, in GB; 0: four fifths of what the machine has"
    )
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
        """Check nested values on top of the preset that they name.

        Args:
            values: settings by name, tables nested.
            where: source of the values, for the error message.

        Raises:
            ConfigError: a key is unknown, or a value has the wrong type or is out of range; lists the first few.

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
        """Read a settings file, with some values overridden.

        Args:
            path: TOML file.
            overrides: nested values from flags; they win.
        """
        return cls.from_mapping(merge_nested(read_toml(path), overrides or {}), where=str(path))

    def to_toml(self) -> str:
        """Return every setting with its help as a comment; `from_toml` reads it back."""
        return "\n".join(toml_lines(self)) + "\n"


QUALITY_PRESETS: dict[str, dict[str, Any]] = {
    "draft": {
        "matching": {"max_features": 3072, "enlarge_below": 2000},
        "depth": {"max_image_size_px": 640, "neighbors": 3},
        "mesh": {"poisson_depth": 10, "faces": 50_000, "max_image_size_px": 0},
        "texture": {"max_atlas_px": 2048, "max_pages": 1},
    },
    "normal": {},
    "high": {
        "matching": {"max_image_size_px": 3200, "max_features": 16384, "enlarge_below": 8000},
        "depth": {"max_image_size_px": 1400, "neighbors": 5},
        "mesh": {"poisson_depth": 13, "faces": 1_000_000, "max_image_size_px": 3200},
        "texture": {"max_atlas_px": 8192},
    },
}


def merge_nested(low: Mapping[str, Any], high: Mapping[str, Any]) -> dict[str, Any]:
    """Return two nested mappings merged into one.

    Args:
        low: values that are used where `high` has none.
        high: values that win.
    """
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
    return text if len(text) <= MAX_VALUE_CHARS else f"{text[:MAX_VALUE_CHARS]}..."
