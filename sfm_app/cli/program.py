"""The program `sfm-app`: the list of its commands, errors as one line and an exit code."""

import errno
import gc
import logging
import os
import shlex
import sys
import warnings
from collections.abc import Mapping
from io import TextIOWrapper
from pathlib import Path
from types import MappingProxyType
from typing import Any

import click

from sfm_app import __version__
from sfm_app.cli.output import fold_lines, print_lines, terminal_width, to_printable
from sfm_app.errors import SfmError
from sfm_app.operating_system import heed_requests_to_end

INTERRUPTED = 130
FULL_DISK_ERRORS = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""Error numbers of a full disk, of a file that is too large, and of an exhausted quota."""

SECTIONS: Mapping[str, Mapping[str, str]] = MappingProxyType({
    "Make a model": {
        "run": "Reconstruct a 3D model from a folder of photos or a video.",
        "studio": "Do the same in the browser, without a terminal.",
        "calibrate": "Estimate the camera matrix of photos, without a model.",
        "markers": "Make a page of printable markers that set a model's size.",
        "demo": "Render photos of a known scene, reconstruct and compare.",
    },
    "Use a finished run": {
        "view": "Show the model in the browser.",
        "report": "Write the report again, or compare two runs.",
        "export": "Export the model or its cameras for other programs.",
        "measure": "Measure a distance or a volume in the model.",
    },
    "Check and configure": {
        "doctor": "Check this machine and the installed libraries.",
        "config": "Print all settings.",
        "plugins": "List all methods and file formats.",
        "completion": "Print a script that completes commands in your shell.",
    },
})  # fmt: skip
"""Summaries of the functions in `commands`, for the list of commands: that module is not imported for the list."""
ADVICE: Mapping[str, str] = MappingProxyType({
    "Got unexpected extra argument": '. Put quotes around a name with spaces: "My photos"',
    "Option '--scale' requires": ' These are two points and their distance: "measure" in the report prints them.',
})  # fmt: skip
"""Advice to append to a message of click, by the start of the message."""
WELCOME = (
    "sfm-app turns uncalibrated photos into a 3D model.",
    "",
    "  sfm-app run PHOTOS   reconstruct a folder of photos or a video",
    "  sfm-app studio       the same in your browser",
    "  sfm-app demo         try it on rendered photos, in a few minutes",
    "  sfm-app doctor       check this machine",
    "",
    "sfm-app --help lists all commands, sfm-app run --help all options.",
)


class Program(click.Group):
    """Command group that imports its commands on demand and reports each error in one line."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - of click
        """Return the names of the commands, in the order of their sections."""
        return list(self.commands)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - of click
        """Import a command; its entry in `self.commands` has only the name."""
        if cmd_name not in self.commands:
            return None
        from sfm_app.cli import commands

        command: click.Command = getattr(commands, cmd_name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - of click
        """Write the commands, section by section, without an import of any."""
        width = max(map(len, self.commands))
        for title, summaries in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(f"{name:{width}}", summary) for name, summary in summaries.items()])

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run the command line; end the process at once where a call of COLMAP still runs."""
        replace_missing_streams()
        if isinstance(sys.stdout, TextIOWrapper):  # on Windows, a file may lack the letters of other languages
            sys.stdout.reconfigure(errors="backslashreplace")
        try:
            with heed_requests_to_end():
                return super().main(*args, **kwargs)
        finally:
            gc.freeze()  # modules live to the end: their garbage collection would take a third of a second at exit
            colmap = sys.modules.get("sfm_app.colmap.backend")  # None if no command has needed it
            if colmap is not None and colmap.has_running_call():  # a normal exit frees its memory, and crashes
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(INTERRUPTED)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """Find the command; if the user names a folder instead, suggest `sfm-app run`."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as err:
            if not Path(args[0]).exists():
                raise
            message = f"{err.format_message()} To reconstruct this folder: sfm-app run {shlex.quote(args[0])}"
            raise click.UsageError(message, err.ctx) from None

    def invoke(self, ctx: click.Context) -> Any:
        """Run one command and turn its errors into one line and an exit code."""
        try:
            return super().invoke(ctx)
        except SfmError as err:
            fail(str(err), err.hint, err.exit_code)
        except KeyboardInterrupt:
            fail("interrupted", "run the same command again to resume", INTERRUPTED)
        except click.UsageError as err:
            advice = next((advice for start, advice in ADVICE.items() if err.message.startswith(start)), "")
            if not advice:
                raise
            raise click.UsageError(f"{err.message}{advice}", err.ctx) from None
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except OSError as err:  # such as a full disk, or a folder that has been removed
            fail(*describe_os_error(err), 3)
        except Exception as err:  # a bug: the user gets one line, log.txt has the traceback
            fail(f"unexpected {type(err).__name__}: {err}", "this is a bug; please report it with OUT/log.txt", 1)


def replace_missing_streams() -> None:
    """Open streams to nowhere for those that the process lacks, as services do; files would take their numbers."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115 - open to the end


def describe_os_error(err: OSError) -> tuple[str, str]:
    """Return the message and the hint for an error of the operating system."""
    if err.errno in FULL_DISK_ERRORS:
        return f"the disk is full ({err.strerror})", "free some space, then run the same command again to resume"
    path = err.filename or "a file of this run"
    return f"{err.strerror or err}: {path}", "fix this, then run the same command again to resume"


def fail(message: str, hint: str, code: int) -> None:
    """Print an error and its hint, and exit with a code > 0."""
    hints = hint.split("\n") if hint else []
    lines = [f"error: {message}", *(f"{'' if number else 'hint: '}{line}" for number, line in enumerate(hints))]
    lines, width = [to_printable(line) for line in lines], terminal_width(sys.stderr)
    for line in fold_lines(lines, width) if width else lines:
        sys.stderr.write(f"{line}\n")
    sys.exit(code)


@click.group(
    cls=Program,
    commands={name: click.Command(name) for summaries in SECTIONS.values() for name in summaries},
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name="sfm-app")
@click.pass_context
def main(ctx: click.Context) -> None:
    """Turn a folder of uncalibrated photos, or a video, into a 3D model."""
    warnings.filterwarnings("ignore", module=r"PIL\b")  # the stage `photos` reports damaged photos itself
    logging.captureWarnings(capture=True)  # log.txt has them: they tell a user nothing
    if ctx.invoked_subcommand is None:
        print_lines(WELCOME)
