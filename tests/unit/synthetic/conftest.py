from pathlib import Path

import pytest

from sfm_app.synthetic.cameras import ArcOptions, Views, arc, make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, Truth, write_photo_folder
from sfm_app.synthetic.shapes import Body, Material, SyntheticScene, ball, box, ground


@pytest.fixture(scope="session")
def still_life() -> SyntheticScene:
    """A ball on a box on the ground: small and quick."""
    gray = Material(pattern="stone", base=(150, 150, 150), second=(90, 90, 90))
    red = Material(pattern="brick", base=(170, 60, 50), second=(200, 120, 90))
    bodies = (
        Body(ground((-3.0, 3.0), (-3.0, 3.0), unevenness=0.0, spacing=0.5), gray),
        Body(box(1.0, 0.8, 1.0).move(turn_deg=30.0), red),
        Body(ball(0.5, segments=48).move((0.0, 1.3, 0.0)), gray),
    )
    return SyntheticScene("still life", bodies)


@pytest.fixture(scope="session")
def four_views() -> Views:
    return arc(make_camera(120, 80), ArcOptions(photos=4, aim=(0.0, 0.8, 0.0), aim_spread=0.2))


@pytest.fixture(scope="session")
def photos(still_life, four_views, tmp_path_factory) -> tuple[Path, Truth]:
    folder = tmp_path_factory.mktemp("rendered") / "photos"
    return folder, write_photo_folder(folder, still_life, four_views, PhotoOptions(seed=3))
