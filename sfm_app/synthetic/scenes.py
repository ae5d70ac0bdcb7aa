"""Synthetic scenes by name."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from sfm_app.errors import ConfigError
from sfm_app.synthetic.bodies import SyntheticScene
from sfm_app.synthetic.courtyard import courtyard
from sfm_app.synthetic.small_scenes import heap, poster

SCENES: Mapping[str, Callable[[], SyntheticScene]] = MappingProxyType(
    {"courtyard": courtyard, "poster": poster, "heap": heap}
)


def build_scene(name: str = "courtyard") -> SyntheticScene:
    """The scene of that name.

    Raises:
        ConfigError: there is none; names the known ones.
    """
    if name not in SCENES:
        raise ConfigError(f"no synthetic scene is named '{name}'", hint=f"known: {', '.join(SCENES)}")
    return SCENES[name]()
