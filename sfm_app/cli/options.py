"""Options that several commands share, and how they become settings."""

import tomllib
from collections.abc import Mapping
from functools import reduce
from pathlib import Path
from typing import Any

import click

from sfm_app.cli.setting_flags import SETTING_FLAGS, Command, setting_field, setting_option
from sfm_app.errors import ConfigError
from sfm_app.settings import Settings, merge_nested


def settings_options(command: Command) -> Command:
    """Add the options that change settings, from --config to -v."""
    without = (setting_field("plugins").description or "").partition(";")[0]
    options = (
        click.option(
            "--config", type=click.Path(path_type=Path), help="Settings file (TOML); `sfm-app config` prints one."
        ),
        *(setting_option(flag) for flag in SETTING_FLAGS),
        click.option("--no-plugins", is_flag=True, help=f"Do not {without}."),
        click.option("--set", "assignments", multiple=True, metavar="TABLE.KEY=VALUE", help="Any other setting."),
        click.option(
            "-v",
            "--verbose",
            count=True,
            help="Print all that was found, and COLMAP's warnings; -vv shows all of its log.",
        ),
    )
    return reduce(lambda wrapped, option: option(wrapped), reversed(options), command)


def output_options(command: Command) -> Command:
    """Add --json and -q."""
    command = click.option("-q", "--quiet", is_flag=True, help="No progress.")(command)
    return click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")(command)


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
    """Return TABLE.KEY=VALUE as nested settings; ConfigError where it is malformed."""
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
