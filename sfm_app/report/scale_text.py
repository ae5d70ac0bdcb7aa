"""The real size of a scene, in sentences."""

from collections.abc import Iterator, Mapping
from typing import Any

from sfm_app.lengths import format_length
from sfm_app.name_lists import list_names
from sfm_app.scale.measuring import Distance

SHOWN = 3
"""Most pieces of evidence that are named."""


def scale_lines(counts: Mapping[str, Any]) -> Iterator[str]:
    """Yield the size of the scene as lines of text.

    Args:
        counts: figures of the stage `scale` in the manifest.
    """
    if counts["unit"] == "meter":
        names = counts["source"].split(", ")
        yield f"size        in meters, +- {counts['deviation_percent']:.2g} %, by {list_names(names, SHOWN)}"
    else:
        yield 'size        not known: "measure" in the report, --markers or --gcp give it'
    for text in (*counts["contradictions"], *counts["problems"]):
        yield f"            beware: {text}"


def distance_text(found: Distance) -> str:
    """Return a distance for people.

    Args:
        found: the distance.
    """
    if not found.metric:
        return (
            f"{found.value:.6g} +- {found.deviation:.2g} in the model's own unit; --scale, --markers or --gcp of "
            "`sfm-app run` turn it into meters"
        )
    return f"{format_length(found.value)} +- {format_length(found.deviation)}"
