"""The result page of surfaces."""

from collections.abc import Mapping, Sequence

from benchmarks.common.results import Row, table
from benchmarks.surface.bars import bar_rows

TRUTH = (
    "photos", "placed", "triangles", "accuracy %", "completeness %", "F %", "median %", "within 0.1 %",
    "completeness of 3 photos %", "sparse: accuracy %", "sparse: completeness %", "sparse: F %", "sparse: median %",
    "sparse: trim",
)  # fmt: skip
PHOTOS = (
    "photos", "placed", "triangles", "texture pages", "coverage %", "worst coverage %", "not black %",
    "coverage of not black %",
    "PSNR dB", "worst PSNR dB", "left out", "left out: PSNR dB", "left out: PSNR lower by dB",
)  # fmt: skip
DETAIL = (
    "photos", *(f"{name} {limit:g} %" for limit in (0.05, 0.1, 0.2, 0.4) for name in ("accuracy", "completeness", "F")),
    "flakes %", "edges: median %", "edges: mean %", "edges within 0.1 %", "thin things %", "ground at a low angle %",
)  # fmt: skip
KINECT = (
    "photos", "moved by", "accuracy 3 cm %", "3 cm of a point %", "completeness 5 cm %", "median cm",
    "over 10 cm off %", "in reach %", "in reach: accuracy 3 cm %", "in reach: median cm", "moved by cm", "scaled by %",
    "median center cm", "90 % center cm", "cameras apart cm", "cameras turned deg", "turned about m",
    "which explains %", "scan: rough cm",
)  # fmt: skip
ICP = "ICP: "
"""Begins the names of figures after the second alignment."""
COST = ("photos", "placed", "seconds together", "seconds per photo")


def page(about: str, rows: Sequence[Row], parts: Sequence[Row], files_of: Mapping[str, str]) -> str:
    """Return the page: bars first, then all figures, then the pictures that were drawn, by set."""
    columns = list(dict.fromkeys(key for row in (*rows, *parts) for key in row))
    stages = [key for key in columns if key.startswith(("s of ", "MB "))]
    files = [key for key in columns if key.startswith("kB ")]
    found = [
        f"# Surfaces\n\n{about}\n",
        f"## Asked and measured\n\n{table(bar_rows(rows))}" if bar_rows(rows) else "",
        _section("Rendered scenes, against the true surface", [row for row in rows if "accuracy %" in row], TRUTH),
        _section("Rendered scenes, in detail", [row for row in rows if "flakes %" in row], DETAIL),
        _section("Real photos, against the scan of a depth camera", _kinect_rows(rows), KINECT),
        _section("Real photos, against the model rendered into their cameras", _photo_rows(rows), PHOTOS),
        _section("Seconds, memory, files", rows, (*COST, *stages, *files)),
        _section("The same set with fewer and more photos", parts, (*COST, *stages)),
        _section("Failed", [row for row in rows if row["failed"]], ("photos", "failed")),
    ]
    pictures = [f"![{name}]({file})" for name, file in files_of.items()]
    if pictures:
        found.append("## Pictures\n\nA photo, the model from its camera, from beside it, and its bare shape.\n")
    return "\n".join([*(part for part in found if part), *pictures, ""])


def _kinect_rows(rows: Sequence[Row]) -> list[Row]:
    """Return two rows for each set: after alignment by the cameras, and after ICP."""
    found = []
    for row in rows:
        if "accuracy 3 cm %" in row:
            found.append(row | {"moved by": "cameras"})
            after = {name.removeprefix(ICP): value for name, value in row.items() if name.startswith(ICP)}
            if after:
                found.append({"photos": row["photos"], "moved by": "cameras, then ICP"} | after)
    return found


def _photo_rows(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if "coverage %" in row]


def _section(title: str, rows: Sequence[Row], columns: Sequence[str]) -> str:
    known = [name for name in columns if any(row.get(name) not in (None, "") for row in rows)]
    return f"## {title}\n\n{table(rows, known)}" if rows else ""
