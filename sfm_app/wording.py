"""Names and lengths as text, and lengths and points from text."""

import math
import re
from collections.abc import Sequence


def list_names(names: Sequence[str], most: int) -> str:
    """Return the first names with commas, and the number of further names."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


METERS = {
    "mm": 1e-3, "cm": 1e-2, "dm": 1e-1, "m": 1.0, "km": 1e3, "in": 0.0254, "inch": 0.0254, '"': 0.0254, "ft": 0.3048,
    "'": 0.3048, "yd": 0.9144,
}  # fmt: skip
"""By unit; the inch is 25.4 mm by definition."""
LENGTH = re.compile(r"\s*([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*([a-zA-Z'\"]*)\s*")


def parse_length(text: str) -> float:
    """Return a length such as 1.25m, 50 mm or 3ft in meters; ValueError for others, and without a unit."""
    match = LENGTH.fullmatch(text)
    unit = match.group(2).lower() if match else ""
    if match is None or unit not in METERS:
        reason = f"'{text}' is no length" if unit or not match else f"'{text}' is no length without a unit"
        raise ValueError(f"{reason}; write 1.25m, 50mm or 3ft")
    try:
        length = float(match.group(1)) * METERS[unit]
    except ValueError:
        raise ValueError(f"'{text}' is no length; write 1.25m, 50mm or 3ft") from None
    if not (0 < length < math.inf):
        raise ValueError(f"'{text}' is no length: it has to be positive")
    return length


def parse_point(text: str) -> tuple[float, float, float]:
    """Return a point such as 0.5,-1.25,3; raise a ValueError if it is not three finite numbers."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"'{text}' is no point; write three numbers with commas, such as 0.5,-1.25,3") from None
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"'{text}' is no point: it is not finite")
    return x, y, z


def format_length(meters: float) -> str:
    """Return a length >= 0 with four digits in the most readable unit."""
    for unit in ("km", "m", "cm", "mm"):
        if meters >= METERS[unit] or unit == "mm":
            return f"{meters / METERS[unit]:.4g} {unit}"
    return ""
