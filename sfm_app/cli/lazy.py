"""A group of commands whose modules are imported when one is called: `--help` and completion need none of them."""

from collections.abc import Iterator, Mapping, MutableMapping
from importlib import import_module
from typing import Any, NamedTuple

import click
from click.shell_completion import CompletionItem


class Entry(NamedTuple):
    """A command that may not be imported yet."""

    module: str
    """It has a function of the command's name."""
    summary: str
    """One line for the list of commands."""


class LazyCommands(MutableMapping[str, click.Command]):
    """Commands by name, each imported when it is looked up.

    Args:
        entries: where they are.
    """

    def __init__(self, entries: Mapping[str, Entry]) -> None:
        self.entries = dict(entries)
        self.loaded: dict[str, click.Command] = {}

    def __getitem__(self, name: str) -> click.Command:
        if name not in self.loaded:
            self.loaded[name] = getattr(import_module(self.entries[name].module), name)
        return self.loaded[name]

    def __setitem__(self, name: str, command: click.Command) -> None:
        self.loaded[name] = command
        self.entries.setdefault(name, Entry(command.callback.__module__, command.get_short_help_str()))

    def __delitem__(self, name: str) -> None:
        del self.entries[name]
        self.loaded.pop(name, None)

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)


class LazyGroup(click.Group):
    """A group whose help lists commands in sections, and imports none of them for that.

    Args:
        sections: commands by name, by the title of their section.
        settings: as `click.Group` has them.
    """

    def __init__(self, *, sections: Mapping[str, Mapping[str, Entry]], **settings: Any) -> None:
        self.sections = sections
        self.lazy = LazyCommands({name: entry for part in sections.values() for name, entry in part.items()})
        super().__init__(**settings, commands=self.lazy)

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - of click
        """Return the names of the commands, in the order of their sections.

        Args:
            ctx: of the group.
        """
        return list(self.lazy)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - of click
        """Write the commands, section by section.

        Args:
            ctx: of the group.
            formatter: takes the text.
        """
        width = max(map(len, self.lazy))
        for title, entries in self.sections.items():
            with formatter.section(title):
                formatter.write_dl([(f"{name:{width}}", entry.summary) for name, entry in entries.items()])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Return the commands and options that begin so.

        Args:
            ctx: of the group.
            incomplete: what has been typed of it.
        """
        found = [
            CompletionItem(name, help=entry.summary)
            for name, entry in self.lazy.entries.items()
            if name.startswith(incomplete)
        ]
        return [*found, *click.Command.shell_complete(self, ctx, incomplete)]
