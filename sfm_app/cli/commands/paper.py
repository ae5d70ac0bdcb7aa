"""The command that makes markers of paper."""

from pathlib import Path

import click

from sfm_app.cli.output import file_lines, print_lines
from sfm_app.errors import ConfigError
from sfm_app.lengths import parse_length
from sfm_app.scale.marker_page import PAGES_MM, write_marker_page
from sfm_app.scale.markers import FAMILIES


@click.command()
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
    "--family",
    type=click.Choice(tuple(FAMILIES)),
    metavar="NAME",
    default="apriltag-36h11",
    show_default=True,
    help=f"Kind of markers: {', '.join(FAMILIES)}.",
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
