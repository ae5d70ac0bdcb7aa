"""Bars that the surfaces must meet, and whether they do."""

from collections.abc import Mapping, Sequence

from benchmarks.cameras.bars import Bar, lower_bound, upper_bound
from benchmarks.common.results import Row
from benchmarks.surface.sets import REAL, RENDERED, SCANNED

WIDELY_SEEN = ("fountain-P11", "Herz-Jesus-P8")
"""Sets whose photos show mainly the object."""
TIMED = "fountain-P11"
"""The set whose depth maps, mesh and texture together have a time limit, on two cores."""
ON_BLACK = ("temple16",)
"""Sets on a black background, whose photos may show less of the object than the bar."""
BARS: Mapping[str, tuple[Bar, ...]] = (
    {name: (lower_bound("accuracy %", 90.0), lower_bound("completeness %", 85.0)) for name in RENDERED}
    | {
        name: (
            lower_bound("worst coverage %", 75.0 if name in WIDELY_SEEN else 50.0),
            lower_bound("worst PSNR dB", 20.0),
            upper_bound("left out: PSNR lower by dB", 2.0),
            *((upper_bound("seconds together", 90.0),) if name == TIMED else ()),
            *((lower_bound("coverage of not black %", 50.0),) if name in ON_BLACK else ()),
        )
        for name in REAL
    }
    | {name: (lower_bound("accuracy 3 cm %", 80.0), lower_bound("completeness 5 cm %", 70.0)) for name in SCANNED}
)
"""By photo set: shares of the surface for rendered and scanned scenes, coverage and PSNR of the photos for others."""


def bar_rows(rows: Sequence[Row], bars: Mapping[str, tuple[Bar, ...]] = BARS) -> list[Row]:
    """Return one row per bar: the bar, the measured value, and whether it is met.

    Args:
        rows: figures of photo sets.
        bars: by photo set.
    """
    found = []
    for row in rows:
        for bar in bars.get(row["photos"], ()):
            value = row.get(bar.column)
            reached = value is not None and (value <= bar.bound if bar.at_most else value >= bar.bound)
            found.append({
                "photos": row["photos"],
                "asked": f"{bar.column} {'at most' if bar.at_most else 'at least'} {bar.bound:g}",
                "measured": value,
                "met": "not measured" if value is None else "yes" if reached else "**no**",
            })  # fmt: skip
    return found
