"""All commands. What takes long to import is imported when a command runs, so that --help prints at once."""

import os
import platform
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, get_args

import click
from click.shell_completion import get_completion_class

import sfm_app
from sfm_app.cli.options import PATH, json_option, output_options, setting_field, settings_from_flags, settings_options
from sfm_app.cli.output import STAGE_TITLES, file_lines, open_browser, print_json, print_lines, print_text, table
from sfm_app.errors import ConfigError, SfmError
from sfm_app.wording import parse_length, parse_point

if TYPE_CHECKING:
    from sfm_app.formats.exporters import Exporter, SceneExporter

SCENES = {
    "courtyard": "a court with things in it, 12 photos from its open side",
    "statue": "a bust on a plinth, 18 photos all round it",
    "fisheye": "the court again, 12 photos through a fisheye of 180 degrees",
}
"""Scenes of the demo by name; importing `sfm_app.demo` takes seconds."""
STAGES = tuple(STAGE_TITLES)
MARKER_FAMILIES = tuple(name for name in get_args(setting_field("scale.marker_family").annotation) if name != "auto")
PAPERS = ("a4", "a3", "letter")
FORMAT_KINDS = ("exporters", "scene_exporters")
MAPS = {
    "orthophoto": "Cloud Optimized GeoTIFF of the model from above, or from the front of --plane; QGIS",
    "dsm": "the same with heights, or distances from --plane",
    "dtm": "the same of the bare ground, without houses and trees",
    "contours": "GeoPackage with lines of equal height; QGIS",
}
"""Formats of `sfm_app.maps`, which loads rasterio."""
POINT = re.compile(r"[-+]?[\d.]+[^,\s]*,")
"""Beginning of a point x,y,z."""
SHELLS = ("bash", "zsh", "fish")
GIGABYTE, MB_PER_GB = 2**30, 2**30 / 1e6
ENOUGH_DISK = 2 * GIGABYTE


@click.command()
@click.argument("photos", type=PATH, nargs=-1, required=True)
@click.option("-o", "--out", type=PATH, help="Output folder.  [default: PHOTOS-model beside PHOTOS]")
@click.option(
    "--from",
    "first",
    type=click.Choice(STAGES),
    metavar="STAGE",
    help=f"Run this stage and all later ones again: {', '.join(STAGES)}.",
)
@click.option("--until", "last", type=click.Choice(STAGES), metavar="STAGE", default="files", help="Last stage.")
@settings_options
@output_options
def run(photos: tuple[Path, ...], out: Path | None, first: str | None, last: str, **flags: Any) -> None:
    """Reconstruct PHOTOS, a folder, a video, or several photos, folders and ZIPs, as a textured mesh.

    The mesh is OUT/model.ply and OUT/model.glb. An interrupted run resumes: stages with up-to-date results in OUT are
    skipped.
    """
    from sfm_app.cli.outcome import outcome_lines, run_lines, run_steps, run_summary
    from sfm_app.cli.terminal import Terminal
    from sfm_app.photos.gather import expand

    settings, start_s, quiet = settings_from_flags(flags), monotonic(), flags["quiet"]
    if out is None and len(expand(photos)) > 1:
        raise ConfigError("several inputs have no folder for the results", hint="name one with -o")
    folder = out or _default_folder(photos[0].resolve())
    with Terminal(quiet=quiet) as progress:
        result = sfm_app.reconstruct(photos, folder, settings, first=first or "", last=last, progress=progress)
    if flags["as_json"]:
        print_json(run_summary(result))
        return
    seconds = monotonic() - start_s
    print_text(run_lines(result) if flags["verbose"] else outcome_lines(result, seconds))
    if not quiet and sys.stdout.isatty():
        print_lines(run_steps(result, photos, out, settings))


def _default_folder(photos: Path) -> Path:
    folder, here = photos.with_name(f"{photos.name}-model"), Path.cwd()
    return folder.relative_to(here) if folder.is_relative_to(here) else folder


@click.command()
@click.argument("photos", type=PATH, nargs=-1, required=True)
@click.option("-o", "--out", type=PATH, help="Keep features and matches in this folder.")
@click.option("--figure", type=PATH, help="Plot votes, lens and residuals in this PNG, SVG or PDF.")
@settings_options
@output_options
def calibrate(photos: tuple[Path, ...], out: Path | None, figure: Path | None, **flags: Any) -> None:
    """Estimate the camera matrix of PHOTOS, named as in `sfm-app run`, without reconstructing the scene."""
    from sfm_app.cli.terminal import Terminal
    from sfm_app.report.text import intrinsics_lines, intrinsics_summary

    settings = settings_from_flags(flags)
    with Terminal(quiet=flags["quiet"]) as progress:
        intrinsics = sfm_app.calibrate_photos(photos, settings, out=out, figure=figure, progress=progress)
    print_json(intrinsics_summary(intrinsics)) if flags["as_json"] else print_text(intrinsics_lines(intrinsics))


@click.command()
@click.argument("side")
@click.option(
    "-o", "--output", "target", type=PATH, default=Path("markers.pdf"), show_default=True, help="PDF or SVG to write."
)
@click.option(
    "--family",
    type=click.Choice(MARKER_FAMILIES),
    metavar="NAME",
    default="apriltag-36h11",
    show_default=True,
    help=f"Marker family: {', '.join(MARKER_FAMILIES)}.",
)
@click.option("--first", type=click.IntRange(0, 10_000), default=0, show_default=True, help="Number of the first.")
@click.option("--paper", type=click.Choice(PAPERS), default="a4", show_default=True, help="Size of the page.")
def markers(side: str, target: Path, family: str, first: int, paper: str) -> None:
    """Make a page of markers to print and to place in the scene; SIDE is their side length, such as 50mm.

    `sfm-app run PHOTOS --markers 50mm` then gives the model its real size.
    """
    from sfm_app.frame.markers import write_marker_page

    try:
        count = write_marker_page(target, parse_length(side), family, first, paper)
    except ValueError as err:
        raise ConfigError(str(err), hint="sfm-app markers 50mm -o markers.pdf") from None
    advice = f"{count} markers; print them, measure a side, and run: sfm-app run PHOTOS --markers {side}"
    print_lines([*file_lines([target]), advice])


@click.command()
@click.option("-o", "--out", type=PATH, help="Output folder.  [default: demo, or demo-SCENE]")
@click.option(
    "--scene",
    type=click.Choice(tuple(SCENES)),
    metavar="NAME",
    default="courtyard",
    show_default=True,
    help="Scene to photograph: " + "; ".join(f"{name}: {text}" for name, text in SCENES.items()) + ".",
)
@click.option("--open/--no-open", "opens", default=None, help="Open the report.  [default: on a terminal]")
@settings_options
@output_options
def demo(out: Path | None, scene: str, opens: bool | None, **flags: Any) -> None:
    """Render photos of a known scene, reconstruct them and print the errors."""
    from sfm_app.cli.outcome import demo_steps
    from sfm_app.cli.terminal import Terminal
    from sfm_app.demo import demo_lines, run_demo

    settings, quiet = settings_from_flags(flags), flags["quiet"]
    folder = out or Path("demo" if scene == "courtyard" else f"demo-{scene}")
    with Terminal(quiet=quiet) as progress:
        run, result = run_demo(folder, scene, settings, progress)
    interactive = sys.stdout.isatty() and not quiet
    if flags["as_json"]:
        print_json(asdict(result))
    else:
        print_text(demo_lines(result))
        if interactive:
            print_lines(demo_steps(run, scene))
    if opens is None:
        opens = interactive and not flags["as_json"] and not os.environ.get("CI")
    if opens and run.report_path is not None:
        open_browser(run.report_path.resolve().as_uri())


@click.command()
@click.argument("out", type=PATH)
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port to listen on.  [default: a free one]")
@click.option("--host", default="", help="Address to listen at for other machines (0.0.0.0: all), with a token.")
@click.option("--no-browser", is_flag=True, help="Only print the address.")
def view(out: Path, port: int, host: str, no_browser: bool) -> None:
    """Show the run in OUT, with the model at full size, in the browser of this machine, until Ctrl-C.

    With --host, browsers of other machines can show it, too: whoever has the printed address, which contains a token.
    From there, put the name of this machine in the place of 127.0.0.1.
    """
    from sfm_app.cli.terminal import Terminal

    def announce(address: str) -> None:
        progress.close()
        print_lines([f"{address} shows {out}; stop with Ctrl-C"])
        sys.stdout.flush()  # a program may wait for the address
        if not no_browser:
            open_browser(address)

    with Terminal(quiet=False) as progress:
        sfm_app.view_run(out, port=port, host=host, started=announce, progress=progress)


@click.command()
@click.argument("folder", type=PATH, default=Path("models"), required=False)
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port to listen on.  [default: a free one]")
@click.option(
    "--host", default="", help="Address to listen at for other machines (0.0.0.0: all); nothing is encrypted."
)
@click.option("--no-browser", is_flag=True, help="Only print the address.")
def studio(folder: Path, port: int, host: str, no_browser: bool) -> None:
    """Make models in the browser of this machine; FOLDER (models) holds them, until Ctrl-C.

    What the page does, the command line can continue. With --host, telephones and other machines can use it, too:
    whoever has the printed address, which contains a token. From there, put the name of this machine in the place of
    127.0.0.1.
    """
    try:
        from sfm_app.studio.server import serve_studio
    except ModuleNotFoundError as err:
        if err.name not in ("starlette", "uvicorn"):
            raise
        raise ConfigError(f"the studio needs {err.name}", hint="pip install 'sfm-app[studio]'") from None

    def announce(address: str) -> None:
        print_lines([f"{address} shows the projects in {folder.resolve()}; stop with Ctrl-C"])
        if host:
            print_lines([
                "on other devices, the name or address of this machine stands in the place of 127.0.0.1",
                "whoever reads the network can read along: there is no encryption",
            ])  # fmt: skip
        sys.stdout.flush()  # a program may wait for the address
        if not no_browser:
            open_browser(address)

    serve_studio(folder, port, host, announce)


@click.command()
@click.argument("out", type=PATH)
@click.option("--compare", type=PATH, help="Output folder of another run, for a comparison.")
def report(out: Path, compare: Path | None) -> None:
    """Write OUT/report.html again: the results of the run in OUT on one page, which needs no network."""
    print_lines(file_lines([sfm_app.write_report(out, compare)]))


class ExportCommand(click.Command):
    """A command whose help ends with the list of formats, those of plug-ins included."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Join the points behind --plane, which may begin with a minus, to one word."""
        joined = list[str]()
        for word in args:
            joins = "--plane" in joined[-2:-1] and POINT.match(word) and POINT.match(joined[-1])
            joined[-1:] = [f"{joined[-1]} {word}"] if joins else [*joined[-1:], word]
        return super().parse_args(ctx, joined)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of formats."""
        with formatter.section("Formats"):
            formatter.write_dl(list(format_summaries().items()))
        super().format_epilog(ctx, formatter)


@click.command(cls=ExportCommand)
@click.argument("out", type=PATH)
@click.option(
    "--format",
    "file_format",
    default="",
    metavar="NAME",
    shell_complete=lambda _ctx, _parameter, start: [name for name in format_summaries() if name.startswith(start)],
    help="One of the formats below.  [default: the suffix of the output file]",
)
@click.option(
    "-o",
    "--output",
    "target",
    type=PATH,
    help="File or folder to write.  [default: OUT/model.FORMAT, OUT/cameras.json, OUT/export/FORMAT, ...]",
)
@click.option("--points", is_flag=True, help="Export the sparse points and the cameras instead of the model.")
@click.option(
    "--box", nargs=2, metavar="A B", help="Export what is between these corners, x,y,z in the frame of OUT/model.glb."
)
@click.option(
    "--resolution", default="", metavar="LENGTH", help="Pixel of a map, such as 2cm.  [default: as the photos]"
)
@click.option(
    "--plane",
    default="",
    metavar="A B [C]",
    help="Map of a plane, by 3 points x,y,z as in `measure`; 2 points: of a section; `facade`: of the main wall.",
)
@click.option("--interval", default="", metavar="LENGTH", help="Step of contours.  [default: twenty or more]")
@click.option("--ground", is_flag=True, help="Contours of the bare ground, without houses and trees.")
@output_options
def export(  # noqa: PLR0913 - the options of the command
    out: Path, file_format: str, target: Path | None, points: bool, box: tuple[str, str] | None, resolution: str,
    plane: str, interval: str, ground: bool, quiet: bool, as_json: bool,
) -> None:  # fmt: skip
    """Write the results of the run in OUT for another program, without recomputing anything."""
    from sfm_app.cli.terminal import Terminal
    from sfm_app.formats.exporters import CLOUD
    from sfm_app.plugins import load_plugins

    name, methods = choose_format(file_format, target), load_plugins()
    try:
        corners = None if box is None else [parse_point(corner) for corner in box]
    except ValueError as err:
        raise ConfigError(str(err), hint="--box -1,0,-0.5 1,2,0.5") from None
    is_model, is_map = name in methods.exporters, name in MAPS
    is_cloud = name in methods.scene_exporters and methods.scene_exporters[name].needs == CLOUD
    fits = {"points": is_model, "box": is_model or is_cloud, "resolution": is_map, "plane": is_map}
    fits |= dict.fromkeys(("interval", "ground"), name == "contours")
    given = {"points": points, "box": box, "resolution": resolution, "plane": plane, "interval": interval}
    given["ground"] = ground
    for option, value in given.items():
        if value and not fits[option]:
            raise ConfigError(f"--{option} does not apply to the format '{name}'", hint="omit it")
    if is_map:
        from sfm_app.maps.products import MapOptions, export_map

        with Terminal(quiet=quiet or as_json) as progress:
            options = MapOptions(resolution, plane, interval, ground)
            paths = list(export_map(out, name, target, options, progress=progress))
    elif name in methods.scene_exporters:
        with Terminal(quiet=quiet or as_json) as progress:
            paths = [sfm_app.export_scene(out, name, target, box=corners, progress=progress)]
    else:
        paths = list(sfm_app.export_model(out, name, target, points=points, box=corners))
    print_json([str(path) for path in paths]) if as_json else print_lines(file_lines(paths))


def known_formats() -> "dict[str, Exporter | SceneExporter]":
    """Return all formats by name, those for models first."""
    from sfm_app.plugins import load_plugins

    methods = load_plugins()
    return {**methods.exporters, **methods.scene_exporters}


def format_summaries() -> dict[str, str]:
    """Return the summaries of all formats by name."""
    return {name: part.summary for name, part in known_formats().items()} | MAPS


def choose_format(name: str, target: Path | None) -> str:
    """Return the name of a format; an empty one stands for the suffix of the target; ConfigError for an unknown one."""
    formats = known_formats()
    suffix = target.suffix.removeprefix(".").lower() if target is not None else ""
    if not name and suffix:  # a format of that name has priority over others with that suffix
        matches = [key for key, part in formats.items() if part.suffix == suffix]
        name = suffix if suffix in formats else next(iter(matches), suffix)
    if name in formats or name in MAPS:
        return name
    lines = [f"  {line}" for line in table(format_summaries())]
    message = f"no file format is named '{name}'" if name else "no format is given"
    raise ConfigError(message, hint="\n".join(["add --format with one of these, or -o model.obj:", *lines]))


@click.command(context_settings={"ignore_unknown_options": True})  # coordinates may begin with a minus
@click.argument("out", type=PATH)
@click.argument("a", required=False)
@click.argument("b", required=False)
@click.option("--volume", "polygon", metavar="POLYGON", help="Corners in order around a heap or pit, in quotes.")
@json_option
def measure(out: Path, a: str | None, b: str | None, polygon: str | None, as_json: bool) -> None:
    """Print the distance between the points A and B, or the volume in a polygon, with standard deviations.

    A point is x,y,z in the coordinates of OUT/model.glb. The volume is above and below the plane through the corners.
    """
    from sfm_app.report.text import distance_text, volume_lines

    hint = 'sfm-app measure OUT 0.1,0.2,0.3 1,0,-0.5, or sfm-app measure OUT --volume "0,0,0 1,0,0 1,0,-1"'
    if (polygon is None) != (b is not None) or (polygon is not None and a is not None):
        raise ConfigError("name two points, or the corners of a polygon", hint=hint)
    try:
        if polygon is None:
            distance = sfm_app.measure_distance(out, parse_point(a or ""), parse_point(b or ""))
            values, lines = distance.to_dict(), [distance_text(distance)]
        else:
            volume = sfm_app.measure_volume(out, [parse_point(corner) for corner in polygon.split()])
            values, lines = volume.to_dict(), list(volume_lines(volume))
    except ValueError as err:
        raise ConfigError(str(err), hint=hint) from None
    print_json(values) if as_json else print_text(lines)


@click.command()
@json_option
def doctor(as_json: bool) -> None:
    """Check this machine and the installed libraries."""
    state = examine()
    print_json(state) if as_json else print_text(table(state))


def examine() -> dict[str, str]:
    """Return the state of this machine and of the installed libraries, one line each."""
    from sfm_app.colmap.backend import has_cuda
    from sfm_app.engine.stage import versions
    from sfm_app.operating_system import free_memory_mb, missing_abilities
    from sfm_app.runtime.parallel import worker_count

    disk = shutil.disk_usage(Path.cwd()).free
    return {
        "python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
        "cores": str(worker_count(0)),
        "memory": f"{free_memory_mb() / MB_PER_GB:.0f} GB free",
        "free disk here": f"{disk / GIGABYTE:.0f} GB"
        + ("" if disk > ENOUGH_DISK else "; low: dense stereo needs about 2 GB"),
        "missing in this system": ", ".join(missing_abilities()) or "nothing",
        **versions(),
        "COLMAP with CUDA": "yes" if has_cuda() else "no",
        "depth maps": _try(_depth_method),
        "ray casting (Open3D)": _try(_open3d),
        "plug-ins": _try(_count_methods),
    }


def _open3d() -> str:
    from sfm_app.meshing.ray_casting import load_open3d

    return f"works, {load_open3d().__version__}"


def _try(examine_part: Callable[[], str]) -> str:
    try:
        return examine_part()
    except SfmError as err:
        return f"broken: {err}; {err.hint}"


def _depth_method() -> str:
    from sfm_app.plugins import load_plugins

    method, reason = load_plugins().depth_method("auto")
    return f"{method.name} ({reason})"


def _count_methods() -> str:
    from sfm_app.plugins import load_plugins

    methods = load_plugins()
    parts = {
        "feature methods": methods.features,
        "estimators": methods.estimators,
        "calibrators": methods.calibrators,
        "formats": {**methods.exporters, **methods.scene_exporters},
        "depth methods": methods.depth_methods,
    }
    return ", ".join(f"{len(part)} {name}" for name, part in parts.items())


@click.command()
@settings_options
def config(**flags: Any) -> None:
    """Print all settings as TOML, with the changes of the other options."""
    print_lines(settings_from_flags(flags).to_toml().splitlines())


@click.command()
def plugins() -> None:
    """List features, estimators, calibrators, file formats and depth methods."""
    from sfm_app.plugins import load_plugins

    methods = load_plugins()
    for kind in ("features", "camera_priors", "estimators", "calibrators", *FORMAT_KINDS, "depth_methods"):
        rows = table({method.name: method.summary for method in getattr(methods, kind).values()})
        if rows:
            print_text([f"{kind.replace('_', ' ')}:", *(f"  {row}" for row in rows)])


@click.command()
@click.argument("shell", type=click.Choice(SHELLS))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print a script that completes commands, options and names of methods in SHELL.

    \b
    bash: sfm-app completion bash >> ~/.bashrc
    zsh:  sfm-app completion zsh >> ~/.zshrc
    fish: sfm-app completion fish > ~/.config/fish/completions/sfm-app.fish
    """
    kind = get_completion_class(shell)
    if kind is not None:
        print_lines(kind(ctx.find_root().command, {}, "sfm-app", "_SFM_APP_COMPLETE").source().splitlines())
