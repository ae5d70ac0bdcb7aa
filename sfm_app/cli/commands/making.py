"""Commands that make models, and what is needed for that."""

from pathlib import Path
from time import monotonic
from typing import Any

import click

import sfm_app
from sfm_app.cli.options import output_options, settings_from_flags, settings_options
from sfm_app.cli.output import print_json, print_lines, print_text
from sfm_app.cli.stage_titles import STAGE_TITLES
from sfm_app.demo import COURTYARD, SCENES

STAGES = tuple(STAGE_TITLES)


@click.command()
@click.argument("photos", type=click.Path(path_type=Path))
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), help="Output folder.  [default: PHOTOS-model beside PHOTOS]"
)
@click.option(
    "--from",
    "first",
    type=click.Choice(STAGES),
    metavar="STAGE",
    default=None,
    help=f"Redo everything from this stage on: {', '.join(STAGES)}.",
)
@click.option(
    "--until", "last", type=click.Choice(STAGES), metavar="STAGE", default="files", help="Stop after this stage."
)
@settings_options
@output_options
def run(photos: Path, out: Path | None, first: str | None, last: str, **flags: Any) -> None:
    """Reconstruct PHOTOS, a folder or a video: camera, poses and a mesh as OUT/model.ply and OUT/model.glb.

    Stages whose results in OUT are up to date are skipped, so an interrupted run resumes where it stopped.
    """
    from sfm_app.cli.display import run_lines, run_summary
    from sfm_app.cli.ending.next_steps import run_steps
    from sfm_app.cli.outcome import outcome_lines
    from sfm_app.cli.terminal import Terminal

    settings, start = settings_from_flags(flags), monotonic()
    place = out or _choose_place(photos.resolve())
    with Terminal(quiet=flags["quiet"]) as progress:
        done = sfm_app.reconstruct(photos, place, settings, first=first or "", last=last, progress=progress)
    if flags["as_json"]:
        print_json(run_summary(done))
        return
    took_s = monotonic() - start
    print_text(run_lines(done) if flags["verbose"] else outcome_lines(done, took_s))
    print_lines(run_steps(done, photos, out, settings, quiet=flags["quiet"]))


def _choose_place(photos: Path) -> Path:
    """Return the folder for a run where none is named, as short as a person would write it here."""
    place, here = photos.with_name(f"{photos.name}-model"), Path.cwd()
    return place.relative_to(here) if place.is_relative_to(here) else place


@click.command()
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
    from sfm_app.cli.terminal import Terminal
    from sfm_app.report.camera_text import intrinsics_lines, intrinsics_summary

    settings = settings_from_flags(flags)
    with Terminal(quiet=flags["quiet"]) as progress:
        found = sfm_app.calibrate_photos(photos, settings, out=out, figure=figure, progress=progress)
    print_json(intrinsics_summary(found)) if flags["as_json"] else print_text(intrinsics_lines(found))


@click.command()
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Output folder.  [default: demo, or demo-SCENE]")
@click.option(
    "--scene",
    type=click.Choice(tuple(SCENES)),
    metavar="NAME",
    default=COURTYARD,
    show_default=True,
    help="What is photographed: " + "; ".join(f"{name}: {text}" for name, text in SCENES.items()) + ".",
)
@click.option(
    "--open/--no-open",
    "opens",
    default=None,
    help="Open the report in the browser.  [default: on a terminal that has one]",
)
@settings_options
@output_options
def demo(out: Path | None, scene: str, opens: bool | None, **flags: Any) -> None:
    """Render photos of a known scene, reconstruct them and print the errors."""
    from sfm_app.cli.browser import open_report
    from sfm_app.cli.ending.next_steps import demo_steps
    from sfm_app.cli.terminal import Terminal
    from sfm_app.demo.result import demo_lines
    from sfm_app.demo.running import run_demo

    settings, quiet = settings_from_flags(flags), flags["quiet"]
    place = out or Path("demo" if scene == COURTYARD else f"demo-{scene}")
    with Terminal(quiet=quiet) as progress:
        run, result = run_demo(place, scene, settings, progress)
    if flags["as_json"]:
        print_json(result.to_dict())
    else:
        print_text(demo_lines(result))
        print_lines(demo_steps(run, scene, quiet=quiet))
    open_report(run.report_path, opens, quiet=quiet or flags["as_json"])
