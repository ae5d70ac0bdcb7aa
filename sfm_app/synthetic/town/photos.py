"""Photos of a walk through a town with known truth, for sets of thousands.

A walk is taken once; smaller sets are its first photos, in the same town. `photo_folder.add_missing_photos` writes
them.
"""

from dataclasses import dataclass

import numpy as np

from sfm_app.errors import ConfigError
from sfm_app.synthetic.cameras import Camera, Views
from sfm_app.synthetic.scenes.bodies import SyntheticScene
from sfm_app.synthetic.scenes.town import town
from sfm_app.synthetic.town_walk import walk_town


@dataclass(frozen=True, slots=True, kw_only=True)
class TownPhotos:
    """A town, and the walk through it.

    Raises:
        ConfigError: a value is out of range.
    """

    photos: int = 1000
    """Of the whole walk, >= 2; the town is as large as the walk can cover."""
    step_m: float = 1.2
    """Length of a step from photo to photo."""
    look_alikes: float = 0.1
    """Share of houses that stand in several streets, 0..1."""
    seed: int = 0
    """Same seed, same town and same walk."""

    def __post_init__(self) -> None:
        if self.photos < 2 or not 0 < self.step_m < 50 or not 0 <= self.look_alikes <= 1:
            raise ConfigError("synthetic town: photos, step_m or look_alikes is out of range")


def town_of(options: TownPhotos) -> SyntheticScene:
    """Return the town that a walk leads through.

    Args:
        options: the walk.
    """
    blocks = walk_town(options.photos, options.step_m, options.seed).blocks
    return town(blocks, options.look_alikes, options.seed)


def town_views(camera: Camera, options: TownPhotos, count: int | None = None) -> Views:
    """Return the photos of a walk in their order, named street_0000.jpg and so on.

    Args:
        camera: of all photos.
        options: the walk.
        count: photos from its beginning that are taken; all if None.
    """
    walk = walk_town(options.photos, options.step_m, options.seed)
    poses = [np.column_stack([R, -R @ center]) for R, center in zip(walk.rotations, walk.centers, strict=True)][:count]
    named = {f"street_{k:04d}.jpg": pose for k, pose in enumerate(poses)}
    return Views(dict.fromkeys(named, camera), named)
