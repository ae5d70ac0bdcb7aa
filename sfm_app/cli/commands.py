"""The commands of `sfm-app`."""

import errno
import gc
import os
import sys
import warnings
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import click

from sfm_app import __version__
from sfm_app.api import (
    calibrate_photos,
    export_model,
    export_scene,
    measure_distance,
    reconstruct,
    view_run,
    write_report,
)
from sfm_app.cli.browser import open_browser
from sfm_app.cli.display import (
    file_lines,
    print_json,
    print_lines,
    run_lines,
    run_summary,
    table,
    to_printable,
)
from sfm_app.cli.doctor import examine
from sfm_app.cli.formats import ExportCommand, choose_format
from sfm_app.cli.options import output_options, settings_from_flags, settings_options
from sfm_app.cli.outcome import outcome_lines
from sfm_app.cli.terminal import Terminal
from sfm_app.colmap.backend import has_running_call
from sfm_app.demo import demo_lines, run_demo
from sfm_app.errors import ConfigError, SfmError
from sfm_app.lengths import parse_length, parse_point
from sfm_app.pipeline import NAMES
from sfm_app.plugins import load_plugins
from sfm_app.report.camera_text import intrinsics_lines, intrinsics_summary
from sfm_app.report.scale_text import distance_text
from sfm_app.scale.marker_page import PAGES_MM, write_marker_page
from sfm_app.scale.markers import FAMILIES

INTERRUPTED = 130
FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""Error numbers of a full disk, of a file that is too large, and of an exhausted quota."""


class Commands(click.Group):
    """Command group that turns errors into one line and an exit code."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run the command line; end the process at once where a call of COLMAP still runs."""
        if isinstance(sys.stdout, TextIOWrapper):  # in a file, Windows has no letters but those of its own language
            sys.stdout.reconfigure(errors="backslashreplace")
        gc.freeze()  # what is imported lives to the end: looking through it again takes a third of a second at exit
        try:
            return super().main(*args, **kwargs)
        finally:
            if has_running_call():  # a normal exit frees what the call works on, and crashes
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(INTERRUPTED)

    def invoke(self, ctx: click.Context) -> Any:
        """Run one command and turn its errors into one line and an exit code."""
        try:
            return super().invoke(ctx)
        except SfmError as err:
            fail(str(err), err.hint, err.exit_code)
        except KeyboardInterrupt:
            fail("interrupted", "the same command continues where this one stopped", INTERRUPTED)
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
    """Print an error and its hint, and exit.

    Args:
        message: what went wrong.
        hint: what to do about it; may be empty.
        code: exit code, > 0.
    """
    advice = "\n".join(map(to_printable, hint.split("\n")))
    click.echo(f"error: {to_printable(message)}" + (f"\nhint: {advice}" if hint else ""), err=True)
    sys.exit(code)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="sfm-app")
def main() -> None:
    """Turn a folder of uncalibrated photos, or a video, into a 3D model."""
    warnings.filterwarnings("ignore", module=r"PIL\b")  # we report problems with photos ourselves, once


@main.command()
@click.argument("photos", type=click.Path(path_type=Path))
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), help="Output folder.  [default: PHOTOS-model beside PHOTOS]"
)
@click.option("--from", "first", type=click.Choice(NAMES), default=None, help="Redo everything from this stage on.")
@click.option("--until", "last", type=click.Choice(NAMES), default="files", help="Stop after this stage.")
@settings_options
@output_options
def run(photos: Path, out: Path | None, first: str | None, last: str, **flags: Any) -> None:
    """Reconstruct PHOTOS, a folder or a video: camera, poses and a mesh as OUT/model.ply and OUT/model.glb.

    Stages whose results in OUT are up to date are skipped, so an interrupted run resumes where it stopped.
    """
    settings = settings_from_flags(flags)
    out = out or photos.resolve().with_name(f"{photos.resolve().name}-model")
    done = reconstruct(photos, out, settings, first=first or "", last=last, progress=Terminal(quiet=flags["quiet"]))
    if flags["as_json"]:
        print_json(run_summary(done))
    else:
        print_lines(run_lines(done) if flags["verbose"] else outcome_lines(done))


@main.command()
@click.argument("photos", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Keep features and matches in this folder.")
@click.option(
    "--figure",
    type=click.Path(path_type=Path),
    help="Draw the pairs' votes, the curve of the lens and the residuals into this PNG, SVG or PDF file.",
)
@settings_options
@output_options
def calibrate(photos: Path, out: Path | None, figure: Path | None, **flags: Any) -> None:
    """Find the camera matrix of PHOTOS, a folder or a video, without reconstructing the scene."""
    progress = Terminal(quiet=flags["quiet"])
    found = calibrate_photos(photos, settings_from_flags(flags), out=out, figure=figure, progress=progress)
    print_json(intrinsics_summary(found)) if flags["as_json"] else print_lines(intrinsics_lines(found))


@main.command(cls=ExportCommand)
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--format", "file_format", default="", help="One of the formats below.  [default: the suffix of TARGET]")
@click.option(
    "-o",
    "--output",
    "target",
    type=click.Path(path_type=Path),
    help="File or folder to write.  [default: OUT/model.FORMAT, OUT/cameras.json, OUT/export/FORMAT, ...]",
)
@click.option("--points", is_flag=True, help="Export the sparse points and the cameras instead of the model.")
@output_options
def export(out: Path, file_format: str, target: Path | None, points: bool, quiet: bool, as_json: bool) -> None:
    """Write what the run in OUT has found for another program, without recomputing anything."""
    name = choose_format(file_format, target)
    if name in load_plugins().scene_exporters:
        if points:
            raise ConfigError(f"--points does not go with the format '{name}'", hint="leave it out")
        paths = [export_scene(out, name, target, progress=Terminal(quiet=quiet or as_json))]
    else:
        paths = list(export_model(out, name, target, points=points))
    print_json([str(path) for path in paths]) if as_json else print_lines(file_lines(paths))


@main.command(context_settings={"ignore_unknown_options": True})  # coordinates may begin with a minus
@click.argument("out", type=click.Path(path_type=Path))
@click.argument("a")
@click.argument("b")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def measure(out: Path, a: str, b: str, as_json: bool) -> None:
    """Print the distance between the places A and B, each x,y,z as in OUT/model.glb, with its standard deviation."""
    try:
        found = measure_distance(out, parse_point(a), parse_point(b))
    except ValueError as err:
        raise ConfigError(str(err), hint="sfm-app measure OUT 0.1,0.2,0.3 1,0,-0.5") from None
    print_json(found.to_dict()) if as_json else print_lines([distance_text(found)])


@main.command()
@click.argument("side")
@click.option(
    "-o",
    "--output",
    "target",
    type=click.Path(path_type=Path),
    default=Path("markers.pdf"),
    show_default=True,
    help="PDF or SVG file to write.",
)
@click.option(
    "--family", type=click.Choice(tuple(FAMILIES)), default="apriltag-36h11", show_default=True, help="Kind of markers."
)
@click.option("--first", type=click.IntRange(0, 10_000), default=0, show_default=True, help="Number of the first one.")
@click.option("--paper", type=click.Choice(tuple(PAGES_MM)), default="a4", show_default=True, help="Size of the page.")
def markers(side: str, target: Path, family: str, first: int, paper: str) -> None:
    """Make a page of markers of side SIDE, such as 50mm, to print and lay beside what is photographed.

    `sfm-app run PHOTOS --markers 50mm` then gives the model its real size.
    """
    try:
        count = write_marker_page(target, parse_length(side), family, first, paper)
    except ValueError as err:
        raise ConfigError(str(err), hint="sfm-app markers 50mm -o markers.pdf") from None
    print_lines(
        [*file_lines([target]), f"{count} markers; measure one after printing: sfm-app run PHOTOS --markers {side}"]
    )


@main.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--compare", type=click.Path(path_type=Path), help="Output folder of another run, to be set beside it.")
def report(out: Path, compare: Path | None) -> None:
    """Write OUT/report.html again: what the run in OUT has found, as one page that opens without a network."""
    print_lines(file_lines([write_report(out, compare)]))


@main.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port to listen on.  [default: a free one]")
@click.option("--no-browser", is_flag=True, help="Only print the address.")
def view(out: Path, port: int, no_browser: bool) -> None:
    """Show the run in OUT in the browser, with the model at full size, to this machine only; Ctrl-C ends it."""

    def announce(address: str) -> None:
        print_lines([f"{address} shows {out}; Ctrl-C ends it"])
        sys.stdout.flush()  # whoever reads it through a pipe waits for it
        if not no_browser:
            open_browser(address)

    view_run(out, port=port, started=announce, progress=Terminal(quiet=False))


@main.command()
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), default=Path("demo"), show_default=True, help="Output folder."
)
@settings_options
@output_options
def demo(out: Path, **flags: Any) -> None:
    """Render photos of a known scene, reconstruct them and print the errors."""
    result = run_demo(out, settings_from_flags(flags), Terminal(quiet=flags["quiet"]))
    print_json(result.to_dict()) if flags["as_json"] else print_lines(demo_lines(result))


@main.command()
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def doctor(as_json: bool) -> None:
    """Show what this machine has and lacks."""
    found = examine()
    print_json(found) if as_json else print_lines(table(found))


@main.command()
@settings_options
def config(**flags: Any) -> None:
    """Print all settings as TOML, including the changes by other options."""
    print_lines(settings_from_flags(flags).to_toml().splitlines())


@main.command()
def plugins() -> None:
    """List features, estimators, calibrators, file formats and depth methods."""
    found = load_plugins()
    for title, parts in (
        ("features", found.features),
        ("estimators", found.estimators),
        ("calibrators", found.calibrators),
        ("exporters", found.exporters),
        ("scene exporters", found.scene_exporters),
        ("depth methods", found.depth_methods),
    ):
        print_lines([f"{title}:", *(f"  {line}" for line in table({p.name: p.summary for p in parts.values()}))])
