"""Lists of names, and lengths, as text."""

import math
import re
from collections.abc import Sequence

# Lists of names in sentences.


def list_names(names: Sequence[str], most: int) -> str:
    """Return the first few names with commas, and how many more there are.

    Args:
        names: any number of them.
        most: how many are named.
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


# Read lengths with a unit, and points in space, as people write them.

METERS = {
    "mm": 1e-3, "cm": 1e-2, "dm": 1e-1, "m": 1.0, "km": 1e3, "in": 0.0254, "inch": 0.0254, '"': 0.0254, "ft": 0.3048,
    "'": 0.3048, "yd": 0.9144,
}  # fmt: skip
"""By unit; the inch is 25.4 mm by definition."""
LENGTH = re.compile(r"\s*([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*([a-zA-Z'\"]*)\s*")


def parse_length(text: str) -> float:
    """Read a length such as 1.25m, 50 mm or 3ft.

    Args:
        text: a positive number and its unit. A bare number is refused: 50 may be meant as millimeters.

    Returns:
        meters.

    Raises:
        ValueError: it is no length, not positive, or of an unknown unit.
    """
    found = LENGTH.fullmatch(text)
    unit = found.group(2).lower() if found else ""
    if found is None or unit not in METERS:
        reason = f"'{text}' is no length" if unit or not found else f"'{text}' is no length without a unit"
        raise ValueError(f"{reason}; write 1.25m, 50mm or 3ft")
    try:
        length = float(found.group(1)) * METERS[unit]
    except ValueError:
        raise ValueError(f"'{text}' is no length; write 1.25m, 50mm or 3ft") from None
    if not (0 < length < math.inf):
        raise ValueError(f"'{text}' is no length: it has to be positive")
    return length


def parse_point(text: str) -> tuple[float, float, float]:
    """Read a point in space, such as 0.5,-1.25,3.

    Args:
        text: three numbers with commas between them.

    Raises:
        ValueError: it is not three finite numbers.
    """
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"'{text}' is no point; write three numbers with commas, such as 0.5,-1.25,3") from None
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"'{text}' is no point: it is not finite")
    return x, y, z


def format_length(meters: float) -> str:
    """Return a length in the unit that reads best, with four digits.

    Args:
        meters: any length >= 0.
    """
    for unit in ("km", "m", "cm", "mm"):
        if meters >= METERS[unit] or unit == "mm":
            return f"{meters / METERS[unit]:.4g} {unit}"
    return ""
