"""The formats of `sfm-app export`: their list, and which one a command line means."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sfm_app.errors import ConfigError

if TYPE_CHECKING:  # all methods are imported with them
    from sfm_app.formats.exporters import Exporter, SceneExporter


class ExportCommand(click.Command):
    """A command whose help ends with the list of formats, those of plug-ins included."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of formats.

        Args:
            ctx: of the command.
            formatter: takes the text.
        """
        with formatter.section("Formats"):
            formatter.write_dl([(name, part.summary) for name, part in known_formats().items()])
        super().format_epilog(ctx, formatter)


def known_formats() -> "dict[str, Exporter | SceneExporter]":
    """Return all formats by name, those for models first."""
    from sfm_app.plugins import load_plugins

    found = load_plugins()
    return {**found.exporters, **found.scene_exporters}


def is_of_scenes(name: str) -> bool:
    """Return whether a format is one for cameras, poses, points and photos instead of models."""
    from sfm_app.plugins import load_plugins

    return name in load_plugins().scene_exporters


def choose_format(name: str, target: Path | None) -> str:
    """Return the name of the format that is asked for.

    Args:
        name: as given; empty for the suffix of the target.
        target: file or folder; None for the usual place.

    Raises:
        ConfigError: there is no such format, or neither a name nor a suffix.
    """
    formats = known_formats()
    suffix = target.suffix.removeprefix(".").lower() if target is not None else ""
    if not name and suffix:  # the format with that name comes before others with that suffix
        alike = [key for key, part in formats.items() if part.ending == suffix]
        name = suffix if suffix in formats else next(iter(alike), suffix)
    if name in formats:
        return name
    width = max(map(len, formats))
    lines = [f"  {key:{width}}  {part.summary}" for key, part in formats.items()]
    message = f"no file format is named '{name}'" if name else "no format is given"
    raise ConfigError(message, hint="\n".join(["--format with one of these, or -o model.obj:", *lines]))
