"""The scenes of the demos, each with a known camera and a walk that shows it."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from sfm_app.demo import COURTYARD
from sfm_app.geometry.camera import camera_matrix
from sfm_app.synthetic.cameras import ArcOptions, Camera, Views, arc, make_camera
from sfm_app.synthetic.lenses import Lens
from sfm_app.synthetic.scenes.bodies import SyntheticScene
from sfm_app.synthetic.scenes.courtyard import courtyard
from sfm_app.synthetic.scenes.facade import facade, facade_views
from sfm_app.synthetic.scenes.statue import statue, statue_views
from sfm_app.synthetic.scenes.town import town
from sfm_app.synthetic.town.photos import TownPhotos, town_views

SIZE = (960, 640)
"""Width and height of the photos of most scenes, in pixels: large enough for a good model, small enough to wait for."""
CIRCLE_SIZE, CIRCLE_CENTER, CIRCLE_RADIUS_PX = (800, 600), (410.0, 296.0), 300.0
"""Of the photos through the fisheye: size, optical center, and radius of the circle that shows 180 degrees, in pixels.
As in `benchmarks.lenses.picture`."""
CLOSE = (2.4, 3.6)
"""Distance of the fisheye from the middle of the court: farther away, it shows little of it. Chosen by hand."""


class DemoScene(NamedTuple):
    """What is photographed, and from where."""

    build: Callable[[], SyntheticScene]
    views: Callable[[], Views]


def circular_fisheye() -> Camera:
    """Return an equidistant camera whose circle of 180 degrees is as high as the photo."""
    focal = CIRCLE_RADIUS_PX / (0.5 * np.pi)
    return Camera(camera_matrix(focal, focal, *CIRCLE_CENTER), *CIRCLE_SIZE, Lens("equidistant"))


DEMO_SCENES: Mapping[str, DemoScene] = MappingProxyType({
    COURTYARD: DemoScene(courtyard, lambda: arc(make_camera(*SIZE))),
    "statue": DemoScene(statue, lambda: statue_views(make_camera(640, 960, focal_widths=1.35), photos=18)),
    "facade": DemoScene(facade, lambda: facade_views(make_camera(*SIZE))),
    "town": DemoScene(
        town, lambda: town_views(make_camera(*SIZE, focal_widths=0.8), TownPhotos(photos=20, step_m=1.2))
    ),
    "fisheye": DemoScene(courtyard, lambda: arc(circular_fisheye(), ArcOptions(distance=CLOSE))),
})  # fmt: skip
"""By name, as in `demo.SCENES`. Sizes and numbers of photos: chosen so that each takes less than four minutes on two
cores."""
