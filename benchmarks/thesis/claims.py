"""Claims of the thesis compared with our own measurements."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim of the thesis, and our numbers for it."""

    figure: str
    says: str
    verdict: str
    numbers: str


def verdict(holds: Sequence[bool]) -> str:
    """Return the verdict in words."""
    if all(holds):
        return "holds"
    return "holds in part" if any(holds) else "does not hold"
