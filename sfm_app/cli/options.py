"""Options that several commands share, and how they become settings."""

import tomllib
from collections.abc import Callable, Mapping
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar, get_args

import click

from sfm_app.colmap.backend import show_log
from sfm_app.errors import ConfigError
from sfm_app.settings import Quality, Settings, merged

Command = TypeVar("Command", bound=Callable[..., Any])


OWN_FLAGS = {
    "images": "photos", "masks": "photos", "cameras": "photos", "keep_low_quality": "photos", "max_frames": "photos",
    "features": "matching", "estimator": "epipolar", "calibrator": "calibration",
    "mapper": "scene", "faces": "mesh", "unseen_faces": "texture",
}  # fmt: skip
"""Settings with a flag of their own, and their tables."""


def settings_options(command: Command) -> Command:
    """Add the options that change settings, from --config to -v."""
    options = (
        click.option(
            "--config", type=click.Path(path_type=Path), help="Settings file (TOML); `sfm-app config` prints one."
        ),
        click.option("--seed", type=int, help="Same seed, same result.  [default: 0]"),
        click.option("--workers", type=int, help="Parallel workers.  [default: one per core]"),
        click.option("--max-memory", type=float, metavar="GB", help="Most memory that is used.  [default: 4/5 of all]"),
        click.option("--quality", type=click.Choice(get_args(Quality)), help="Preset of sizes.  [default: normal]"),
        click.option("--images", help="Text file that names the photos to use, one per line.  [default: all]"),
        click.option(
            "--masks",
            help="Folder of masks: of sub/a.jpg, what is black in sub/a.jpg.png is not used.  [default: none]",
        ),
        click.option("--cameras", help="auto, single, folder or each: which photos share one.  [default: auto]"),
        click.option("--max-frames", type=int, help="Most frames of a video that are used.  [default: 100]"),
        click.option(
            "--keep-low-quality", is_flag=True, default=None, help="Use copies, blurred photos and screenshots, too."
        ),
        click.option("--features", help="Way to find and match features.  [default: sift]"),
        click.option("--estimator", help="Estimator of fundamental matrices.  [default: lev-ransac]"),
        click.option("--calibrator", help="Calibrator.  [default: zero-curves]"),
        click.option("--mapper", help="auto, incremental or global.  [default: auto]"),
        click.option("--faces", type=int, help="Most triangles of the mesh.  [default: 200000]"),
        click.option(
            "--unseen-faces",
            type=click.Choice(("color", "cut")),
            help="Triangles that no photo sees.  [default: color]",
        ),
        click.option("--no-plugins", is_flag=True, help="Load nothing but what the program itself has."),
        click.option("--set", "assignments", multiple=True, metavar="TABLE.KEY=VALUE", help="Any other setting."),
        click.option("-v", "--verbose", count=True, help="Show what COLMAP says; -vv shows all of it."),
    )
    return reduce(lambda wrapped, option: option(wrapped), reversed(options), command)


def output_options(command: Command) -> Command:
    """Return --json and -q."""
    command = click.option("-q", "--quiet", is_flag=True, help="No progress.")(command)
    return click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")(command)


def settings_from(flags: Mapping[str, Any]) -> Settings:
    """Return settings from the shared options; flags win over the file."""
    show_log(flags["verbose"])
    overrides: dict[str, Any] = {key: flags[key] for key in ("seed", "workers", "quality") if flags[key] is not None}
    if flags["max_memory"] is not None:
        overrides["max_memory_gb"] = flags["max_memory"]
    if flags["no_plugins"]:
        overrides["plugins"] = False
    for key, table in OWN_FLAGS.items():
        if flags[key] is not None:
            overrides = merged(overrides, {table: {key: flags[key]}})
    for assignment in flags["assignments"]:
        overrides = merged(overrides, assigned(assignment))
    if flags["config"] is not None:
        return Settings.from_toml(flags["config"], overrides)
    return Settings.from_mapping(overrides, where="command line")


def assigned(text: str) -> dict[str, Any]:
    """Return TABLE.KEY=VALUE as nested settings; ConfigError where it is something else."""
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
