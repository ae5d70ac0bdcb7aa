"""Demos: photos of a known scene are rendered, reconstructed and compared with the truth; here, their names."""

from collections.abc import Mapping
from types import MappingProxyType

COURTYARD = "courtyard"
SCENES: Mapping[str, str] = MappingProxyType({
    COURTYARD: "a court with things in it, 12 photos from its open side",
    "statue": "a bust on a plinth, 18 photos all round it",
    "facade": "the front of a house, 12 photos from across the street",
    "town": "a street between houses, 16 photos of a walk along it",
    "fisheye": "the court again, 12 photos through a fisheye of 180 degrees",
})  # fmt: skip
"""What is shown, by the name of the scene; `demo.scenes` builds them. Nothing is imported for the names alone."""
