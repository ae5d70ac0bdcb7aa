"""Build scenes for failure cases: a plane, and a place that shares nothing with the courtyard."""

import numpy as np

from sfm_app.synthetic.scenes.bodies import Body, SyntheticScene
from sfm_app.synthetic.scenes.courtyard import GREEN_MARBLE, LEAVES, MARBLE, PAINT, TERRACOTTA, WOOD
from sfm_app.synthetic.scenes.shapes import ball, box, ground


def poster() -> SyntheticScene:
    """Return a flat wall of veined marble across the view, facing +z."""
    return SyntheticScene("poster", (Body(box(9.0, 6.0, 0.1).move((0.0, -1.5, -0.1)), MARBLE),))


def heap() -> SyntheticScene:
    """Return boxes and balls strewn over leaves."""
    rng = np.random.default_rng(3)
    materials = (WOOD, MARBLE, PAINT, TERRACOTTA, GREEN_MARBLE, LEAVES)
    bodies = [Body(ground((-4.0, 4.0), (-3.0, 5.0), unevenness=0.05), LEAVES)]
    for k in range(18):
        x, z = rng.uniform((-2.5, -2.0), (2.5, 2.0))
        width, height, depth = rng.uniform(0.4, 1.2, 3)
        stood = box(width, height, depth).move((x, 0.0, z), turn_deg=rng.uniform(0.0, 90.0))
        bodies += [
            Body(stood, materials[k % len(materials)]),
            Body(ball(0.3).move((x + 0.4, rng.uniform(1.0, 2.0), z)), materials[(k + 1) % len(materials)]),
        ]
    return SyntheticScene("heap", tuple(bodies))
