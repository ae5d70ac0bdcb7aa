"""Which parameters of a camera the photos tell apart badly, as a table and in sentences."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

from sfm_app.geometry.lenses.camera_models import PARAMETERS
from sfm_app.types import Calibration, CameraModel
from sfm_app.types.correlations import correlation_key

STRONG = 0.5
"""Correlation from which on two parameters are said to depend on each other. Chosen by hand: a quarter of the variance
of the one is then that of the other."""
MOST_SENTENCES = 3
PAIR_PARAMETERS = ("fx", "fy", "cx", "cy", "k1")


@dataclass(frozen=True, slots=True)
class CorrelationTable:
    """Correlations between the parameters of a camera."""

    source: str
    """What they are from."""
    names: Sequence[str]
    """(n,) of the parameters."""
    rows: Sequence[Sequence[float | None]]
    """(n, n), the lower triangle; None above it, and where it is not known."""
    texts: Sequence[str]
    """What it says, in sentences."""


def correlation_table(before: Calibration, after: CameraModel | None) -> CorrelationTable | None:
    """Return the correlations after the last adjustment, else those from pairs; None where none are known.

    Terms of the lens that are 0 are left out, and the second focal of square pixels. A center that the photos do not
    determine is not: where it is off, the focal is off with it.

    Args:
        before: the camera from pairs of photos.
        after: the last adjustment; None where there was none.
    """
    if after is not None and after.correlations:
        values = dict(zip(PARAMETERS.get(after.model, ()), after.params, strict=False))
        left_out = () if "aspect" in after.determined else ("fy",)
        names = [name for name in after.deviations if values.get(name) and name not in left_out]
        return _table("after the last adjustment", names, after.correlations)
    if before.identifiable and before.correlations:
        left_out = ("fy",) if "aspect" in before.held else ()
        names = [name for name in PAIR_PARAMETERS if name not in (*left_out, *before.held)]
        return _table("from pairs of photos", names, before.correlations)
    return None


def _table(source: str, names: Sequence[str], values: Mapping[str, float]) -> CorrelationTable | None:
    """Return the table of some parameters; None where there are fewer than two."""
    if len(names) < 2:
        return None
    called = ["focal" if name == "fx" and "fy" not in names else name for name in names]
    rows = [
        [values.get(correlation_key(names[j], names[i])) if j < i else None for j in range(len(names))]
        for i in range(len(names))
    ]
    return CorrelationTable(source, called, rows, _sentences(called, rows))


def _sentences(names: Sequence[str], rows: Sequence[Sequence[float | None]]) -> list[str]:
    """Return which parameters depend on each other, the most dependent first."""
    found = [(value, names[j], names[i]) for j, i in combinations(range(len(names)), 2) if (value := rows[i][j])]
    found.sort(key=lambda one: -abs(one[0]))
    strong = [one for one in found if abs(one[0]) >= STRONG]
    said = [
        f"{first} and {second} move {'together' if value > 0 else 'against each other'}: {correlation_text(value)}"
        for value, first, second in strong[:MOST_SENTENCES]
    ]
    if len(strong) > len(said):
        said.append(f"and {len(strong) - len(said)} more pairs of parameters")
    if not said and found:
        value, first, second = found[0]
        said = [f"none hides in another: the strongest is {first} with {second}, {correlation_text(value)}"]
    return said


def correlation_text(value: float) -> str:
    """Return a correlation with two digits and a true minus."""
    return f"{value:.2f}".replace("-0.00", "0.00").replace("-", "\N{MINUS SIGN}")
