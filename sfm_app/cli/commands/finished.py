"""Commands for finished runs."""

import sys
from pathlib import Path

import click

import sfm_app
from sfm_app.cli.browser import open_browser
from sfm_app.cli.completions import format_names
from sfm_app.cli.formats import ExportCommand, choose_format, is_of_scenes
from sfm_app.cli.options import output_options
from sfm_app.cli.output import file_lines, print_json, print_lines, print_text
from sfm_app.errors import ConfigError
from sfm_app.lengths import parse_point


@click.command(cls=ExportCommand)
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--format",
    "file_format",
    default="",
    shell_complete=format_names,
    help="One of the formats below.  [default: the suffix of TARGET]",
)
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
    from sfm_app.cli.terminal import Terminal

    name = choose_format(file_format, target)
    if is_of_scenes(name):
        if points:
            raise ConfigError(f"--points does not go with the format '{name}'", hint="leave it out")
        with Terminal(quiet=quiet or as_json) as progress:
            paths = [sfm_app.export_scene(out, name, target, progress=progress)]
    else:
        paths = list(sfm_app.export_model(out, name, target, points=points))
    print_json([str(path) for path in paths]) if as_json else print_lines(file_lines(paths))


@click.command(context_settings={"ignore_unknown_options": True})  # coordinates may begin with a minus
@click.argument("out", type=click.Path(path_type=Path))
@click.argument("a")
@click.argument("b")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def measure(out: Path, a: str, b: str, as_json: bool) -> None:
    """Print the distance between the places A and B, each x,y,z as in OUT/model.glb, with its standard deviation."""
    from sfm_app.report.scale_text import distance_text

    try:
        found = sfm_app.measure_distance(out, parse_point(a), parse_point(b))
    except ValueError as err:
        raise ConfigError(str(err), hint="sfm-app measure OUT 0.1,0.2,0.3 1,0,-0.5") from None
    print_json(found.to_dict()) if as_json else print_text([distance_text(found)])


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--compare", type=click.Path(path_type=Path), help="Output folder of another run, to be set beside it.")
def report(out: Path, compare: Path | None) -> None:
    """Write OUT/report.html again: what the run in OUT has found, as one page that opens without a network."""
    print_lines(file_lines([sfm_app.write_report(out, compare)]))


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port to listen on.  [default: a free one]")
@click.option("--no-browser", is_flag=True, help="Only print the address.")
def view(out: Path, port: int, no_browser: bool) -> None:
    """Show the run in OUT in the browser, with the model at full size, to this machine only; Ctrl-C ends it."""
    from sfm_app.cli.terminal import Terminal

    def announce(address: str) -> None:
        progress.close()
        print_lines([f"{address} shows {out}; Ctrl-C ends it"])
        sys.stdout.flush()  # whoever reads it through a pipe waits for it
        if not no_browser:
            open_browser(address)

    with Terminal(quiet=False) as progress:
        sfm_app.view_run(out, port=port, started=announce, progress=progress)
