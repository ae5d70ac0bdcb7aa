"""Flags that are settings: type, help, range and default come from the field in `settings/`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, get_args

import click
from pydantic.fields import FieldInfo

from sfm_app.cli.completions import Complete, complete_from, complete_names
from sfm_app.settings import QUALITY_PRESETS, Section, Settings, merge_nested

Command = TypeVar("Command", bound=Callable[..., Any])
LOWER_BOUND_FORMATS, UPPER_BOUND_FORMATS = {"ge": "{}<=", "gt": "{}<"}, {"le": "<={}", "lt": "<{}"}
"""Formats of bounds, by pydantic's name for them."""


@dataclass(frozen=True, slots=True)
class SettingFlag:
    """A command-line flag for a setting that is often changed."""

    flag: str
    setting: str
    """Its name in the settings file, such as "mesh.faces"."""
    metavar: str | None = None
    choice: bool = False
    """Whether click checks the value; otherwise `Settings` does, and its error names the table."""
    parts: int = 1
    """Words that it takes; where these are several, it may be given several times."""
    names: str = ""
    """Kind of methods whose names a shell completes, as in `completions`; a choice completes itself."""

    @property
    def parameter(self) -> str:
        """Name of the command's parameter."""
        return self.flag.removeprefix("--").replace("-", "_")

    def to_mapping(self, value: object) -> dict[str, Any]:
        """Return the setting as a mapping of settings."""
        table, _, key = self.setting.rpartition(".")
        return {table: {key: value}} if table else {key: value}


SETTING_FLAGS = (
    SettingFlag("--seed", "seed"),
    SettingFlag("--workers", "workers"),
    SettingFlag("--cluster", "cluster.address", metavar="HOST:PORT|local:N"),
    SettingFlag("--max-memory", "max_memory_gb", metavar="GB"),
    SettingFlag("--quality", "quality", choice=True),
    SettingFlag("--images", "photos.images"),
    SettingFlag("--masks", "photos.masks"),
    SettingFlag("--cameras", "photos.cameras"),
    SettingFlag("--max-frames", "photos.max_frames"),
    SettingFlag("--keep-low-quality", "photos.keep_low_quality"),
    SettingFlag("--features", "matching.features", names="features"),
    SettingFlag("--pairs", "matching.pairs"),
    SettingFlag("--estimator", "epipolar.estimator", names="estimators"),
    SettingFlag("--calibrator", "calibration.calibrator", names="calibrators"),
    SettingFlag("--calibration", "calibration.file", metavar="FILE"),
    SettingFlag("--keep-calibration", "calibration.keep"),
    SettingFlag("--camera-model", "scene.camera_model", metavar="MODEL"),
    SettingFlag("--mapper", "scene.mapper"),
    SettingFlag("--scale", "scale.distances", metavar="A B LENGTH", parts=3),
    SettingFlag("--markers", "scale.markers", metavar="LENGTH"),
    SettingFlag("--gcp", "scale.control_points", metavar="FILE"),
    SettingFlag("--faces", "mesh.faces"),
    SettingFlag("--unseen-faces", "texture.unseen_faces", choice=True),
)


def setting_option(flag: SettingFlag) -> Callable[[Command], Command]:
    """Return the click option of a setting; its value is None, or empty for several words, where it is not given."""
    kind, text = setting_field(flag.setting).annotation, help_text(flag.setting)
    if kind is bool:
        return click.option(flag.flag, is_flag=True, default=None, help=text)
    if flag.parts > 1:
        return click.option(flag.flag, type=str, nargs=flag.parts, multiple=True, metavar=flag.metavar, help=text)
    if flag.choice:
        return click.option(flag.flag, type=click.Choice(get_args(kind)), help=text)
    complete = completion_of(flag, kind)
    kind = kind if kind in (int, float) else str
    return click.option(flag.flag, type=kind, metavar=flag.metavar, help=text, shell_complete=complete)


def completion_of(flag: SettingFlag, kind: Any) -> Complete | None:
    """Return what completes the value of a flag in a shell; None where nothing does.

    Args:
        flag: of the setting.
        kind: type of the setting; a Literal lists its values.
    """
    if flag.names:
        return complete_names(flag.names)
    return complete_from(get_args(kind)) if get_args(kind) else None


def help_text(setting: str) -> str:
    """Return the description of a setting as a sentence, with its default and its range."""
    description = setting_field(setting).description or ""
    facts = "; ".join(fact for fact in (default_text(setting), range_text(setting)) if fact)
    return f"{description[:1].upper()}{description[1:]}." + (f"  [{facts}]" if facts else "")


def default_text(setting: str) -> str:
    """Return the default, one for each quality where the presets differ; empty for empty values and switches."""
    values = {
        quality: setting_value(Settings.from_mapping(merge_nested(preset, {"quality": quality})), setting)
        for quality, preset in QUALITY_PRESETS.items()
    }
    if setting != "quality" and len(set(values.values())) > 1:
        return "default: " + ", ".join(f"{value} for {quality}" for quality, value in values.items())
    value = setting_value(Settings(), setting)
    return "" if value in ("", ()) or isinstance(value, bool) else f"default: {value}"


def range_text(setting: str) -> str:
    """Return the range of a number, such as "1<=x<=9"; empty where there is none."""

    def bound_text(side: Mapping[str, str]) -> str:
        bounds = setting_field(setting).metadata
        pairs = ((bound, name) for bound in bounds for name in side if hasattr(bound, name))
        return "".join(side[name].format(getattr(bound, name)) for bound, name in pairs)

    below, above = bound_text(LOWER_BOUND_FORMATS), bound_text(UPPER_BOUND_FORMATS)
    return f"{below}x{above}" if below or above else ""


def setting_field(setting: str) -> FieldInfo:
    """Return the field of a setting such as "mesh.faces"."""
    section: type[Section] = Settings
    *tables, key = setting.split(".")
    for table in tables:
        section = type(getattr(section(), table))
    return section.model_fields[key]


def setting_value(settings: Section, setting: str) -> Any:
    """Return the value of a setting.

    Args:
        settings: all of them.
        setting: its path, such as "mesh.faces".
    """
    value: Any = settings
    for part in setting.split("."):
        value = getattr(value, part)
    return value
