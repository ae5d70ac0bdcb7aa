"""The program `sfm-app`: its commands by name, errors as one line and an exit code."""

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
from sfm_app.cli.lazy import Entry, LazyGroup
from sfm_app.cli.output import columns, fold_lines, print_lines, to_printable
from sfm_app.errors import SfmError
from sfm_app.operating_system import heed_requests_to_end

INTERRUPTED = 130
FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""Error numbers of a full disk, of a file that is too large, and of an exhausted quota."""

MAKING, PAPER, FINISHED, MACHINE = (
    f"sfm_app.cli.commands.{name}" for name in ("making", "paper", "finished", "machine")
)
SECTIONS: Mapping[str, Mapping[str, Entry]] = MappingProxyType({
    "Make a model": {
        "run": Entry(MAKING, "Make a model of a folder of photos, or of a video."),
        "calibrate": Entry(MAKING, "Find only the camera of photos."),
        "markers": Entry(PAPER, "Make a page of markers that give a model its real size."),
        "demo": Entry(MAKING, "Render photos of a known scene, reconstruct and compare."),
    },
    "Use a finished run": {
        "view": Entry(FINISHED, "Show the model in the browser."),
        "report": Entry(FINISHED, "Write the report again, or beside that of another run."),
        "export": Entry(FINISHED, "Write files for other programs."),
        "measure": Entry(FINISHED, "Measure a distance in the model."),
    },
    "Look after the program": {
        "doctor": Entry(MACHINE, "Show what this machine has and lacks."),
        "config": Entry(MACHINE, "Print all settings."),
        "plugins": Entry(MACHINE, "List all methods and file formats."),
        "completion": Entry(MACHINE, "Print what completes commands in a shell."),
    },
})  # fmt: skip
ADVICE: Mapping[str, str] = MappingProxyType({
    "Got unexpected extra argument": '. A name with blanks needs quotes: "My photos"',
    "Option '--scale' requires": ' Two places and how far apart they are: "measure" in the report prints them.',
})  # fmt: skip
"""What helps newcomers, behind what click says; by how that begins."""
WELCOME = (
    "sfm-app turns photos about which nothing is known into a 3D model.",
    "",
    "  sfm-app run PHOTOS   make a model of a folder of photos, or of a video",
    "  sfm-app demo         see it work: photos of a known scene, in a few minutes",
    "  sfm-app doctor       find out what is wrong with this machine",
    "",
    "sfm-app --help lists all commands, sfm-app run --help what can be changed.",
)
"""What is said to whoever names no command."""


class Program(LazyGroup):
    """Command group that turns errors into one line and an exit code."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run the command line; end the process at once where a call of COLMAP still runs."""
        if isinstance(sys.stdout, TextIOWrapper):  # in a file, Windows has no letters but those of its own language
            sys.stdout.reconfigure(errors="backslashreplace")
        try:
            with heed_requests_to_end():
                return super().main(*args, **kwargs)
        finally:
            gc.freeze()  # what is imported lives to the end: looking through it again takes a third of a second at exit
            colmap = sys.modules.get("sfm_app.colmap.backend")  # None where no command has needed it
            if colmap is not None and colmap.has_running_call():  # a normal exit frees what it works on, and crashes
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(INTERRUPTED)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; whoever names a folder instead is told what to type.

        Args:
            ctx: of the program.
            args: what was typed.
        """
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as err:
            if not Path(args[0]).exists():
                raise
            said = f"{err.format_message()} For a model of this folder: sfm-app run {shlex.quote(args[0])}"
            raise click.UsageError(said, err.ctx) from None

    def invoke(self, ctx: click.Context) -> Any:
        """Run one command and turn its errors into one line and an exit code."""
        try:
            return super().invoke(ctx)
        except SfmError as err:
            fail(str(err), err.hint, err.exit_code)
        except KeyboardInterrupt:
            fail("interrupted", "the same command continues where this one stopped", INTERRUPTED)
        except click.UsageError as err:
            advice = next((advice for begin, advice in ADVICE.items() if err.message.startswith(begin)), "")
            if not advice:
                raise
            raise click.UsageError(f"{err.message}{advice}", err.ctx) from None
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except OSError as err:  # a full disk, a folder that went away
            fail(*describe_os_error(err), 3)
        except Exception as err:  # a bug: the user gets one line, log.txt has the traceback
            fail(f"unexpected {type(err).__name__}: {err}", "this is a bug; please report it with OUT/log.txt", 1)


def describe_os_error(err: OSError) -> tuple[str, str]:
    """Return the message and the hint for an error of the operating system."""
    if err.errno in FULL:
        return f"the disk is full ({err.strerror})", "free some space; the same command resumes where this one stopped"
    where = err.filename or "a file of this run"
    return f"{err.strerror or err}: {where}", "fix that, and run the same command again to resume"


def fail(message: str, hint: str, code: int) -> None:
    """Print an error and its hint, and exit; on a terminal in lines that fit, elsewhere in one line each.

    Args:
        message: what went wrong.
        hint: what to do about it; may be empty.
        code: exit code, > 0.
    """
    advice = hint.split("\n") if hint else []
    said = [f"error: {message}", *(f"{'' if number else 'hint: '}{line}" for number, line in enumerate(advice))]
    lines, width = [to_printable(line) for line in said], columns(sys.stderr)
    for line in fold_lines(lines, width) if width else lines:
        click.echo(line, err=True)
    sys.exit(code)


@click.group(
    cls=Program,
    sections=SECTIONS,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name="sfm-app")
@click.pass_context
def main(ctx: click.Context) -> None:
    """Turn a folder of uncalibrated photos, or a video, into a 3D model."""
    warnings.filterwarnings("ignore", module=r"PIL\b")  # we report problems with photos ourselves, once
    logging.captureWarnings(capture=True)  # log.txt has them: they tell a user nothing
    if ctx.invoked_subcommand is None:
        print_lines(WELCOME)
