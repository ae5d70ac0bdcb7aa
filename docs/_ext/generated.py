"""Text that comes from the code: commands, settings, exit codes, file formats and methods."""

import re
import types
from collections.abc import Callable, Iterator
from typing import Any, Literal, Union, get_args, get_origin

import click
from pydantic.fields import FieldInfo

from sfm_app import errors
from sfm_app.cli.commands import config, known_formats
from sfm_app.cli.options import SETTING_FLAGS, range_text
from sfm_app.cli.program import main
from sfm_app.plugins import load_plugins
from sfm_app.settings import QUALITY_PRESETS, Section, Settings, merge_nested

PROGRAM = "sfm-app"
BESIDES_ERRORS = {
    0: "done",
    1: "a bug: please report it with `OUT/log.txt`",
    130: "interrupted; the same command resumes",
}
"""Exit codes that no error of the program has."""
UNIONS = (Union, types.UnionType)


def commands() -> str:
    """Return every command: how it is called, what it does, its arguments and options."""
    return "\n\n".join(_command_text(command, name) for name, command in _all_commands(main, PROGRAM))


def _all_commands(group: click.Group, path: str) -> Iterator[tuple[str, click.Command]]:
    """Yield all commands of a group and of the groups in it, with what one types to call them."""
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        if command is None:
            continue
        if isinstance(command, click.Group):
            yield from _all_commands(command, f"{path} {name}")
        elif not command.hidden:
            yield f"{path} {name}", command


def _command_text(command: click.Command, name: str) -> str:
    """Return one command as Markdown."""
    context = click.Context(command, info_name=name)
    usage = " ".join((name, *command.collect_usage_pieces(context)))
    shared = _shared_flags()
    own = [option for option in _options(command, context) if option not in shared]
    parts = [f"## {name}", _prose(command.help or ""), f"```\n{usage}\n```"]
    if own:
        parts.append(_table(("option", "what it does"), own))
    if set(shared) <= set(_options(command, context)):
        parts.append("Besides, all [options that change settings](#options-that-change-settings).")
    return "\n\n".join(parts)


def setting_options() -> str:
    """Return the options that several commands share."""
    return _table(("option", "what it does"), _shared_flags())


def _shared_flags() -> list[tuple[str, str]]:
    """Return the options of `sfm-app config`, which has no other."""
    return _options(config, click.Context(config))


def _options(command: click.Command, context: click.Context) -> list[tuple[str, str]]:
    """Return the options of a command, each with its help; what an argument is, the help of the command says."""
    options = (part for part in command.params if isinstance(part, click.Option))
    records = (option.get_help_record(context) for option in options)
    return [(f"`{names}`", _escape(text)) for names, text in filter(None, records)]


def settings() -> str:
    """Return every setting: those without a table, then table by table."""
    plain = {name: field for name, field in Settings.model_fields.items() if not _is_table(field)}
    parts = ["## Without a table", _settings_table("", plain)]
    for name, field in Settings.model_fields.items():
        if _is_table(field):
            section: Any = field.annotation
            parts += [f"## {name}", _prose(section.__doc__ or ""), _settings_table(f"{name}.", section.model_fields)]
    return "\n\n".join(parts)


def _is_table(field: FieldInfo) -> bool:
    return isinstance(field.annotation, type) and issubclass(field.annotation, Section)


def _settings_table(table: str, fields: dict[str, FieldInfo]) -> str:
    """Return settings of one table: name, help, flag, default, type and range."""
    flags = {flag.setting: f" Flag: `{flag.flag}`." for flag in SETTING_FLAGS}
    rows = []
    for key, field in fields.items():
        name = f"{table}{key}"
        anchor = f"setting-{re.sub('[._]', '-', name)}"
        limits = range_text(name)
        kind = type_text(field.annotation) + (f", `{limits}`" if limits else "")
        text = _sentence(_escape(field.description or "")) + flags.get(name, "")
        rows.append((f"[`{key}`](#{anchor}){{#{anchor}}}", text, f"{_default_text(name)}<br>{kind}"))
    return _table(("setting", "what it does", "default, and what is allowed"), rows)


def _sentence(text: str) -> str:
    """Return a description with a capital and a full stop."""
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def type_text(kind: Any) -> str:
    """Return a type of a setting as a person writes it.

    Args:
        kind: annotation of the field.
    """
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(f"`{value}`" for value in get_args(kind))
    if get_origin(kind) in UNIONS:
        return " or ".join(map(type_text, get_args(kind)))
    if get_origin(kind) is tuple:
        return "list of " + " ".join(dict.fromkeys(type_text(part) for part in get_args(kind) if part is not ...))
    names = {bool: "true or false", int: "whole number", float: "number", str: "text"}
    return names.get(kind, getattr(kind, "__name__", str(kind)))


def _default_text(name: str) -> str:
    """Return the default, one for each quality where the presets differ."""
    values = {}
    for quality, preset in QUALITY_PRESETS.items():
        value: Any = Settings.from_mapping(merge_nested(preset, {"quality": quality}))
        for part in name.split("."):
            value = getattr(value, part)
        values[quality] = _toml_value(value)
    if name == "quality":
        return f"`{Settings().quality}`"
    if len(set(values.values())) > 1:
        return ", ".join(f"`{value}` ({quality})" for quality, value in values.items())
    return f"`{values['normal']}`"


def _toml_value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return str(list(value))
    return f'"{value}"' if isinstance(value, str) else str(value)


def exit_codes() -> str:
    """Return the exit codes, and the errors of Python that they stand for."""
    rows = [(code, "", text) for code, text in BESIDES_ERRORS.items()]
    for kind in vars(errors).values():
        if isinstance(kind, type) and issubclass(kind, errors.SfmError) and kind is not errors.SfmError:
            first = (kind.__doc__ or "").strip().split("\n\n")[0]
            rows.append((kind.exit_code, f"{{py:class}}`~sfm_app.errors.{kind.__name__}`", _prose(first)))
    return _table(("code", "error", "what it means"), [(str(c), e, t) for c, e, t in sorted(rows, key=lambda r: r[0])])


def formats() -> str:
    """Return the formats of `sfm-app export`, without those of plug-ins that happen to be installed."""
    own = load_plugins(installed=False)
    names = [*own.exporters, *own.scene_exporters]
    return _table(("format", "what it is"), [(f"`{n}`", _escape(known_formats()[n].summary)) for n in names])


def methods() -> str:
    """Return the built-in methods of every kind, by name."""
    own = load_plugins(installed=False)
    kinds = {
        "Features": (own.features, "--features"),
        "Estimators": (own.estimators, "--estimator"),
        "Calibrators": (own.calibrators, "--calibrator"),
        "Depth methods": (own.depth_methods, "--set depth.method=NAME"),
    }
    parts = []
    for title, (found, flag) in kinds.items():
        rows = [(f"`{part.name}`", _escape(part.summary)) for part in found.values()]
        parts += [f"### {title}", f"Chosen by `{flag}`.", _table(("name", "what it is"), rows)]
    return "\n\n".join(parts)


def _prose(text: str) -> str:
    """Return a docstring as one paragraph for each of its own."""
    return "\n\n".join(" ".join(part.split()) for part in re.split(r"\n\s*\n", text))


def _escape(text: str) -> str:
    """Return text that may stand in a cell of a table."""
    return " ".join(text.split()).replace("|", r"\|").replace("<", "&lt;").replace("*", r"\*")


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a table as Markdown; a bar in code would end its cell."""
    safe = [tuple(re.sub(r"\\?\|", r"\\|", cell) for cell in row) for row in rows]
    lines = [head, tuple("---" for _ in head), *safe]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


GENERATORS: dict[str, Callable[[], str]] = {
    "commands": commands,
    "setting options": setting_options,
    "settings": settings,
    "exit codes": exit_codes,
    "formats": formats,
    "methods": methods,
}
"""By the name in `<!-- here: NAME -->`."""
