"""List the synthetic scenes by name, with typical views of each."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TypeVar

from sfm_app.errors import ConfigError
from sfm_app.synthetic.cameras import Views, arc, make_camera
from sfm_app.synthetic.fine.garden import garden, garden_views
from sfm_app.synthetic.fine.ornament import ornament, ornament_views
from sfm_app.synthetic.fine.railing import railing, railing_views
from sfm_app.synthetic.scenes.bodies import SyntheticScene
from sfm_app.synthetic.scenes.corner import corner, corner_views
from sfm_app.synthetic.scenes.courtyard import courtyard
from sfm_app.synthetic.scenes.facade import facade, facade_views
from sfm_app.synthetic.scenes.small_scenes import heap, poster
from sfm_app.synthetic.scenes.statue import statue, statue_views
from sfm_app.synthetic.scenes.town import town
from sfm_app.synthetic.town.photos import TownPhotos, town_views

SCENES: Mapping[str, Callable[[], SyntheticScene]] = MappingProxyType({
    "courtyard": courtyard, "poster": poster, "heap": heap, "statue": statue, "facade": facade, "corner": corner,
    "town": town, "ornament": ornament, "railing": railing, "garden": garden,
})  # fmt: skip
WALKS: Mapping[str, Callable[[int], Views]] = MappingProxyType({
    "courtyard": lambda seed: arc(make_camera(960, 640), seed=seed),
    "statue": lambda seed: statue_views(make_camera(800, 1152, focal_widths=1.35), seed),
    "facade": lambda seed: facade_views(make_camera(1152, 768), seed),
    "corner": lambda seed: corner_views(make_camera(1152, 768, focal_widths=0.9), seed),
    "town": lambda seed: town_views(
        make_camera(1200, 900, focal_widths=0.8), TownPhotos(photos=40, step_m=1.5, seed=seed)
    ),
    "ornament": lambda seed: ornament_views(make_camera(1800, 1350, focal_widths=1.0), seed),
    "railing": lambda seed: railing_views(make_camera(1800, 1350, focal_widths=0.95), seed),
    "garden": lambda seed: garden_views(make_camera(1800, 1200, focal_widths=1.0), seed),
})  # fmt: skip
"""By scene: a walk with a suitable camera; the seed varies the poses."""

Item = TypeVar("Item")


def build_scene(name: str = "courtyard") -> SyntheticScene:
    """Return the scene of that name.

    Raises:
        ConfigError: there is no such scene; the message names the known ones.
    """
    return _look_up(name, SCENES)()


def scene_views(name: str = "courtyard", seed: int = 0) -> Views:
    """Return the photos of the walk through that scene.

    Args:
        name: of a scene in `WALKS`.
        seed: same seed, same poses.

    Raises:
        ConfigError: there is no such scene; the message names the known ones.
    """
    return _look_up(name, WALKS)(seed)


def _look_up(name: str, known: Mapping[str, Item]) -> Item:
    if name not in known:
        raise ConfigError(f"no synthetic scene is named '{name}'", hint=f"known: {', '.join(known)}")
    return known[name]
