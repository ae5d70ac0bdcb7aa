"""A garden seen at a low angle: gravel, a lawn, a plain white wall, and the sky above it."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.synthetic.cameras import ArcOptions, Camera, Views, arc
from sfm_app.synthetic.fine.fine_shapes import Height, pebbles, relief
from sfm_app.synthetic.scenes.bodies import Body, SyntheticScene
from sfm_app.synthetic.scenes.courtyard import LEAVES, LIMESTONE, SANDSTONE, WOOD
from sfm_app.synthetic.scenes.shapes import Shape, assemble, ball, box
from sfm_app.synthetic.scenes.textures import Material

FloatArray = NDArray[np.float64]

GRAVEL = Material(pattern="stone", base=(176, 168, 154), second=(122, 112, 98), joint=(84, 78, 70), scale=0.07)
GRASS = Material(pattern="leaves", base=(62, 104, 42), second=(128, 152, 70), joint=(30, 52, 22), scale=0.03)
WHITE = Material(
    pattern="stone", base=(226, 224, 218), second=(220, 217, 210), joint=(216, 213, 206), scale=0.4, contrast=0.03
)


def garden() -> SyntheticScene:
    """Return the scene; cameras at the height of a person see most of the ground at 10 to 20 degrees."""
    bench = [box(1.1, 0.05, 0.36).move((0.9, 0.42, -1.2)), box(1.1, 0.3, 0.04).move((0.9, 0.55, -1.37))]
    bench += [box(0.06, 0.42, 0.3).move((0.9 + side * 0.48, 0.0, -1.2)) for side in (-1, 1)]
    bodies = (
        Body(_lying(_gravel, 0.0), GRAVEL),
        *(Body(_lying(_lawn, side * 1.5), GRASS) for side in (-1, 1)),
        *(Body(box(0.06, 0.09, 3.6).move((side * 0.75, -0.03, 0.0)), LIMESTONE) for side in (-1, 1)),
        Body(box(4.5, 1.25, 0.16).move((0.0, 0.0, -1.85)), WHITE),
        Body(box(4.6, 0.07, 0.26).move((0.0, 1.25, -1.85)), SANDSTONE),
        Body(assemble(bench), WOOD),
        Body(ball(0.34, bumps=0.1, seed=8).move((-1.3, 0.3, -1.1)), LEAVES),
        Body(box(0.3, 0.7, 0.3).move((-0.4, 0.0, -1.4), turn_deg=20.0), SANDSTONE),
    )
    return SyntheticScene("garden", bodies, to_light=(-0.5, 0.6, 0.7))


def garden_views(camera: Camera, seed: int = 0) -> Views:
    """Return 16 hand-held photos from the height of a person.

    Args:
        camera: of all photos.
        seed: same seed, same poses.
    """
    walk = ArcOptions(
        photos=16, sweep_deg=70.0, distance=(4.3, 5.2), height=(1.15, 1.6), aim=(0.0, 0.55, -0.5), aim_spread=0.25,
        roll_deg=5.0,
    )  # fmt: skip
    return arc(camera, walk, seed)


def _lying(height: Height, x: float) -> Shape:
    """Return a strip of ground with its middle at x; its texture is that of what faces up."""
    return assemble([relief(height, 1.5, 3.6, 0.007).move((x, 0.0, 1.8), tilt_deg=-90.0)])


def _gravel(x: FloatArray, y: FloatArray) -> FloatArray:
    return pebbles(x, y, (0.012, 0.035), 0.03, seed=1)


def _lawn(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of grass that was cut: tufts of up to 5 cm, a centimeter wide."""
    return pebbles(x, y, (0.006, 0.012), 0.013, seed=2) * 2.5 + 0.012 * np.sin(5.0 * x + 1.0) * np.sin(4.0 * y)
