"""The scenes of the demos, each with a known camera and a walk that shows it."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from benchmarks.synthetic.scenes import facade, facade_views
from benchmarks.synthetic.town import TownPhotos, town, town_views
from sfm_app.demo import COURTYARD
from sfm_app.synthetic.cameras import ArcOptions, Camera, Lens, Views, arc, make_camera, make_wide_camera
from sfm_app.synthetic.scenes import courtyard, statue, statue_views
from sfm_app.synthetic.shapes import SyntheticScene

SIZE = (960, 640)
"""Width and height of the photos of most scenes, in pixels: large enough for a good model, small enough to wait for."""
WIDE_DEG = 150.0
"""What the fisheye sees from left to right: 180 degrees from corner to corner, as fisheyes that fill the photo do."""
CLOSE = (2.4, 3.6)
"""Distance of the fisheye from the middle of the court: farther away, it shows little of it. Chosen by hand."""


class DemoScene(NamedTuple):
    """What is photographed, and from where."""

    build: Callable[[], SyntheticScene]
    views: Callable[[], Views]


def fisheye_camera() -> Camera:
    """Return a camera whose angles to the optical axis grow evenly with the distance from its center."""
    return make_wide_camera(*SIZE, WIDE_DEG, Lens("equidistant"))


DEMO_SCENES: Mapping[str, DemoScene] = MappingProxyType({
    COURTYARD: DemoScene(courtyard, lambda: arc(make_camera(*SIZE))),
    "statue": DemoScene(statue, lambda: statue_views(make_camera(*SIZE[::-1], focal_widths=1.35), photos=18)),
    "facade": DemoScene(facade, lambda: facade_views(make_camera(*SIZE))),
    "town": DemoScene(town, lambda: town_views(make_camera(*SIZE, focal_widths=0.8), TownPhotos(photos=16))),
    "fisheye": DemoScene(courtyard, lambda: arc(fisheye_camera(), ArcOptions(distance=CLOSE))),
})  # fmt: skip
"""By name, as in `demo.SCENES`. Sizes and numbers of photos: chosen so that each takes less than four minutes on two
cores."""
