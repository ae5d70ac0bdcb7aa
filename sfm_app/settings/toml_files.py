"""Settings files: TOML in and out."""

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from sfm_app.errors import ConfigError

MOST_TOML_BYTES = 20_000
"""Most bytes of a settings file. One with every setting has a fifth; a megabyte of dots takes minutes to parse."""


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; ConfigError where it is not valid."""
    hint = "`sfm-app config` prints a valid one"
    try:
        with path.open("rb") as file:
            text = file.read(MOST_TOML_BYTES + 1)
        if len(text) > MOST_TOML_BYTES:
            raise ConfigError(f"{path} is no settings file: it is larger than {MOST_TOML_BYTES} bytes", hint=hint)
        return tomllib.loads(text.decode("utf-8"))
    except OSError as err:
        raise ConfigError(f"cannot read {path}: {err.strerror}") from err
    except RecursionError:
        raise ConfigError(f"{path} is no settings file: it is nested too deeply", hint=hint) from None
    except ValueError as err:  # not TOML, not UTF-8, numbers of thousands of digits
        raise ConfigError(f"{path} is not a TOML file: {err}", hint=hint) from err


def toml_lines(section: BaseModel, table: str = "") -> Iterator[str]:
    """Yield the lines of a settings file, with the help of each setting as a comment.

    Args:
        section: settings, tables nested.
        table: its name in the file; empty for the top.
    """
    fields = type(section).model_fields
    tables = [name for name in fields if isinstance(getattr(section, name), BaseModel)]
    if table:
        yield f"\n# {(section.__doc__ or '').strip()}\n[{table}]"
    for name, info in fields.items():
        if name not in tables:
            yield f"# {info.description}\n{name} = {json.dumps(getattr(section, name))}"
    for name in tables:
        yield from toml_lines(getattr(section, name), name)
