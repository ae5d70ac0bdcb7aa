"""The stages by name, as a person reads of them; nothing is imported for that."""

from collections.abc import Mapping
from types import MappingProxyType

STAGE_TITLES: Mapping[str, str] = MappingProxyType({
    "photos": "reading photos",
    "match_graph": "finding and matching features",
    "view_graph": "fundamental matrices",
    "intrinsics": "camera matrix",
    "scene": "camera poses and points",
    "scale": "real size",
    "depth_maps": "depth maps",
    "mesh": "surface",
    "texture": "texture",
    "files": "files",
})  # fmt: skip
"""In their order; the same as `pipeline.NAMES`."""
