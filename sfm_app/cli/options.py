"""Options that several commands share; type, help, range and default of a setting's flag come from its field."""

import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar, get_args

import click
from pydantic.fields import FieldInfo

from sfm_app.errors import ConfigError
from sfm_app.settings import QUALITY_PRESETS, Section, Settings, merge_nested

Command = TypeVar("Command", bound=Callable[..., Any])
Complete = Callable[[click.Context, click.Parameter, str], list[str]]
LOWER_BOUND_FORMATS, UPPER_BOUND_FORMATS = {"ge": "{}<=", "gt": "{}<"}, {"le": "<={}", "lt": "<{}"}
"""By pydantic's name of the bound."""


@dataclass(frozen=True, slots=True)
class SettingFlag:
    """A command-line flag for a setting that users often change."""

    flag: str
    setting: str
    """Path of the setting, such as "mesh.faces"."""
    metavar: str | None = None
    parts: int = 1
    """Words of one value; a flag of several words may occur several times."""
    methods: str = ""
    """Attribute of `plugins.Plugins` whose names a shell completes."""

    @property
    def parameter(self) -> str:
        """Name of the command's parameter."""
        return self.flag.removeprefix("--").replace("-", "_")

    def to_mapping(self, value: object) -> dict[str, Any]:
        """Return the setting as nested settings."""
        table, _, key = self.setting.rpartition(".")
        return {table: {key: value}} if table else {key: value}


class GivenPath(click.Path):
    """Path of the command line. An empty one, from a variable without a value, would mean the current folder."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; a usage error refuses an empty one."""
        if not os.fspath(value):
            self.fail("it is empty: name a path, or leave the option out", param, ctx)
        return super().convert(value, param, ctx)


PATH = GivenPath(path_type=Path)

SETTING_FLAGS = (
    SettingFlag("--seed", "seed"),
    SettingFlag("--workers", "workers"),
    SettingFlag("--cluster", "cluster.address", metavar="HOST:PORT|local:N"),
    SettingFlag("--max-memory", "max_memory_gb", metavar="GB"),
    SettingFlag("--quality", "quality"),
    SettingFlag("--images", "photos.images", metavar="FILE"),
    SettingFlag("--masks", "photos.masks", metavar="FOLDER"),
    SettingFlag("--positions", "photos.positions", metavar="FILE"),
    SettingFlag("--cameras", "photos.cameras"),
    SettingFlag("--max-frames", "photos.max_frames"),
    SettingFlag("--keep-low-quality", "photos.keep_low_quality"),
    SettingFlag("--features", "matching.features", metavar="NAME", methods="features"),
    SettingFlag("--pairs", "matching.pairs"),
    SettingFlag("--estimator", "epipolar.estimator", metavar="NAME", methods="estimators"),
    SettingFlag("--calibrator", "calibration.calibrator", metavar="NAME", methods="calibrators"),
    SettingFlag("--calibration", "calibration.file", metavar="FILE"),
    SettingFlag("--keep-calibration", "calibration.keep"),
    SettingFlag("--camera-model", "scene.camera_model", metavar="MODEL"),
    SettingFlag("--mapper", "scene.mapper"),
    SettingFlag("--scale", "scale.distances", metavar="A B LENGTH", parts=3),
    SettingFlag("--level", "scale.level", metavar="A B C", parts=3),
    SettingFlag("--markers", "scale.markers", metavar="LENGTH"),
    SettingFlag("--gcp", "scale.control_points", metavar="FILE"),
    SettingFlag("--faces", "mesh.faces"),
    SettingFlag("--watertight", "mesh.watertight"),
    SettingFlag("--unseen-faces", "texture.unseen_faces"),
)


def settings_options(command: Command) -> Command:
    """Add the options that change settings, from --config to -v."""
    plugins = (setting_field("plugins").description or "").partition(";")[0]
    options = (
        click.option("--config", type=PATH, help="Settings file (TOML); `sfm-app config` prints one."),
        *(setting_option(flag) for flag in SETTING_FLAGS),
        click.option("--no-plugins", is_flag=True, help=f"Do not {plugins}."),
        # scripts for older versions pass it
        click.option("--no-picture", is_flag=True, hidden=True, expose_value=False),
        click.option("--set", "assignments", multiple=True, metavar="TABLE.KEY=VALUE", help="Any other setting."),
        click.option("-v", "--verbose", count=True, help="Print all results and COLMAP's warnings; -vv: its log."),
    )
    return reduce(lambda wrapped, option: option(wrapped), reversed(options), command)


def output_options(command: Command) -> Command:
    """Add --json and -q."""
    command = click.option("-q", "--quiet", is_flag=True, help="Print no progress.")(command)
    return json_option(command)


def json_option(command: Command) -> Command:
    """Add --json."""
    return click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")(command)


def setting_option(flag: SettingFlag) -> Callable[[Command], Command]:
    """Return the click option of a setting; without the flag its value is None, or empty for several words."""
    kind: Any = setting_field(flag.setting).annotation
    text = help_text(flag.setting)
    if kind is bool:
        return click.option(flag.flag, is_flag=True, default=None, help=text)
    if flag.parts > 1:
        return click.option(flag.flag, type=str, nargs=flag.parts, multiple=True, metavar=flag.metavar, help=text)
    complete = complete_methods(flag.methods) if flag.methods else None
    if choices := get_args(kind):
        kind = click.Choice(choices)
    if flag.metavar in ("FILE", "FOLDER"):
        kind = GivenPath(path_type=str)
    return click.option(flag.flag, type=kind, metavar=flag.metavar, help=text, shell_complete=complete)


def complete_methods(*kinds: str) -> Complete:
    """Return a shell completion of names of methods, by attributes of `plugins.Plugins`."""

    def complete(_ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
        from sfm_app.plugins import load_plugins

        methods = load_plugins()
        return [name for kind in kinds for name in getattr(methods, kind) if name.startswith(incomplete)]

    return complete


def help_text(setting: str) -> str:
    """Return the description of a setting as a sentence, with its default and its range."""
    description = setting_field(setting).description or ""
    facts = "; ".join(fact for fact in (default_text(setting), range_text(setting)) if fact)
    return f"{description[:1].upper()}{description[1:]}." + (f"  [{facts}]" if facts else "")


def default_text(setting: str) -> str:
    """Return the default, one for each quality if the presets differ; empty for empty values and switches."""
    values = {
        quality: setting_value(Settings.from_mapping(merge_nested(preset, {"quality": quality})), setting)
        for quality, preset in QUALITY_PRESETS.items()
    }
    if setting != "quality" and len(set(values.values())) > 1:
        return "default: " + ", ".join(f"{value} for {quality}" for quality, value in values.items())
    value = setting_value(Settings(), setting)
    return "" if value in ("", ()) or isinstance(value, bool) else f"default: {value}"


def range_text(setting: str) -> str:
    """Return the range of a number, such as "1<=x<=9"; empty if it is unbounded."""

    def bound_text(formats: Mapping[str, str]) -> str:
        bounds = setting_field(setting).metadata
        pairs = ((bound, name) for bound in bounds for name in formats if hasattr(bound, name))
        return "".join(formats[name].format(getattr(bound, name)) for bound, name in pairs)

    lower, upper = bound_text(LOWER_BOUND_FORMATS), bound_text(UPPER_BOUND_FORMATS)
    return f"{lower}x{upper}" if lower or upper else ""


def setting_field(setting: str) -> FieldInfo:
    """Return the field of a setting such as "mesh.faces"."""
    section: type[Section] = Settings
    *tables, key = setting.split(".")
    for table in tables:
        section = type(getattr(section(), table))
    return section.model_fields[key]


def setting_value(settings: Section, setting: str) -> Any:
    """Return the value of a setting such as "mesh.faces"."""
    return reduce(getattr, setting.split("."), settings)


def settings_from_flags(flags: Mapping[str, Any]) -> Settings:
    """Return settings from the shared options; flags override the file."""
    from sfm_app.colmap.backend import show_log  # loads COLMAP

    show_log(flags["verbose"])
    overrides: dict[str, Any] = {"plugins": False} if flags["no_plugins"] else {}
    for flag in SETTING_FLAGS:
        if (value := flags[flag.parameter]) not in (None, ()):
            overrides = merge_nested(overrides, flag.to_mapping(value))
    for assignment in flags["assignments"]:
        overrides = merge_nested(overrides, parse_assignment(assignment))
    if flags["config"] is not None:
        return Settings.from_toml(flags["config"], overrides)
    return Settings.from_mapping(overrides, where="command line")


def parse_assignment(text: str) -> dict[str, Any]:
    """Return TABLE.KEY=VALUE as nested settings; ConfigError if it is malformed."""
    name, equals, value = text.partition("=")
    if not equals:
        raise ConfigError(f"--set {text}: no '=' in it", hint="write --set depth.neighbors=6")
    try:
        return tomllib.loads(f"{name}={value}")
    except (ValueError, RecursionError):
        pass
    try:
        return tomllib.loads(f'{name}="{value}"')  # a word without quotes
    except (ValueError, RecursionError) as err:
        raise ConfigError(f"--set {text}: not TOML: {err}", hint="write --set depth.neighbors=6") from None
