"""Scenes by name, as data: bodies, what they are made of, and the light."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ConfigError
from sfm_app.synthetic.shapes import Shape, arch, ball, box, ground, revolved, torus
from sfm_app.synthetic.textures import Material

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Body:
    """One thing in a scene."""

    shape: Shape
    material: Material


@dataclass(frozen=True, slots=True)
class SyntheticScene:
    """Bodies under a fixed light; y up, scene units are about metres."""

    name: str
    bodies: tuple[Body, ...]
    to_light: tuple[float, float, float] = (0.45, 0.75, 0.5)
    """Direction towards the sun, any length."""
    sun: float = 0.95
    """Brightness of the sun on a surface that faces it."""
    sky: float = 0.5
    """Brightness of the sky on a surface that faces up."""

    @property
    def vertices(self) -> FloatArray:
        """(V, 3) of all bodies."""
        return np.concatenate([body.shape.vertices for body in self.bodies])

    @property
    def faces(self) -> NDArray[np.int64]:
        """(T, 3) vertex indices of all bodies."""
        counts = [len(body.shape.vertices) for body in self.bodies]
        starts = np.cumsum([0, *counts[:-1]])
        return np.concatenate([body.shape.faces + start for body, start in zip(self.bodies, starts, strict=True)])


SANDSTONE = Material(pattern="stone", base=(206, 186, 150), second=(158, 132, 98), scale=0.35, contrast=0.5)
LIMESTONE = Material(pattern="stone", base=(214, 208, 194), second=(166, 158, 142), scale=0.3, contrast=0.45, seed=300)
BRICK = Material(
    pattern="brick", base=(150, 76, 56), second=(188, 116, 84), joint=(190, 182, 168), scale=0.16, contrast=0.6
)
PAVING = Material(pattern="paving", base=(150, 146, 138), second=(116, 112, 108), scale=0.55, contrast=0.6, seed=500)
POTTERY = Material(
    pattern="ceramic", base=(206, 122, 62), second=(44, 34, 32), joint=(226, 198, 150), scale=0.085, contrast=0.45
)
TERRACOTTA = Material(pattern="stone", base=(192, 104, 66), second=(150, 72, 48), scale=0.2, contrast=0.5, seed=700)
WOOD = Material(pattern="wood", base=(178, 132, 82), second=(120, 78, 42), joint=(48, 32, 20), scale=0.24, contrast=0.5)
MARBLE = Material(
    pattern="marble", base=(224, 220, 214), second=(88, 92, 104), joint=(180, 160, 130), scale=0.3, contrast=0.35
)
GREEN_MARBLE = replace(MARBLE, base=(70, 110, 88), second=(206, 214, 196), joint=(30, 52, 44), seed=900)
LEAVES = Material(
    pattern="leaves", base=(46, 92, 34), second=(124, 156, 62), joint=(18, 34, 14), scale=0.055, contrast=0.5
)
PAINT = Material(
    pattern="stripes", base=(38, 84, 140), second=(222, 206, 170), joint=(120, 92, 70), scale=0.2, contrast=0.4
)


def build_scene(name: str = "courtyard") -> SyntheticScene:
    """The scene of that name.

    Raises:
        ConfigError: there is none; names the known ones.
    """
    if name not in SCENES:
        raise ConfigError(f"no synthetic scene is named '{name}'", hint=f"known: {', '.join(SCENES)}")
    return SCENES[name]()


def courtyard() -> SyntheticScene:
    """An amphora on a stepped pedestal in a paved court, with an arcade behind it and odd things around it."""
    floor = Body(ground((-5.2, 5.2), (-3.0, 7.0), unevenness=0.02), PAVING)
    bodies = [floor, *_arcade(), *_side_walls(), *_pedestal(), *_amphora(1.36), *_odd_things()]
    return SyntheticScene("courtyard", tuple(bodies))


SCENES: Mapping[str, Callable[[], SyntheticScene]] = MappingProxyType({"courtyard": courtyard})


def _arcade() -> list[Body]:
    back = -2.6
    bodies = [
        Body(box(10.4, 3.3, 0.4).moved((0.0, 0.0, back - 0.2)), BRICK),
        Body(box(10.4, 0.35, 0.16).moved((0.0, -0.05, back + 0.08)), SANDSTONE),
        Body(box(10.4, 0.22, 0.62).moved((0.0, 3.3, back - 0.1)), SANDSTONE),
    ]
    bodies += [Body(box(0.16, 0.16, 0.2).moved((x, 3.14, back + 0.1)), SANDSTONE) for x in np.arange(-5.0, 5.1, 0.4)]
    column = revolved(_points((0.17, 0.0), (0.13, 1.35)), segments=80, flutes=(20, 0.06))
    ring = revolved(_points((0.0, 0.0), (0.2, 0.0), (0.2, 0.07), (0.16, 0.12), (0.0, 0.12)), segments=48, sharp=True)
    rings = _points((0.65, 0.0), (0.65, 0.06), (0.5, 0.06), (0.35, 0.06), (0.2, 0.06), (0.0, 0.06))
    half_disc = revolved(rings, segments=40, span_deg=180.0, sharp=True)
    for x in (-3.6, -1.8, 0.0, 1.8, 3.6):
        bodies += [
            Body(box(0.5, 0.22, 0.42).moved((x, 0.28, back + 0.2)), SANDSTONE),
            Body(ring.moved((x, 0.5, back + 0.22)), LIMESTONE),
            Body(column.moved((x, 0.6, back + 0.22)), replace(LIMESTONE, seed=round(310 + 10 * x))),
            Body(ring.moved((x, 2.06, back + 0.22), tilt_deg=180.0), LIMESTONE),
            Body(box(0.52, 0.12, 0.44).moved((x, 2.05, back + 0.2)), SANDSTONE),
        ]
    for k, x in enumerate((-2.7, -0.9, 0.9, 2.7)):
        bodies.append(Body(arch(0.68, 0.2, 0.3).moved((x, 2.17, back)), replace(SANDSTONE, seed=100 + 10 * k)))
        plaster = replace(SANDSTONE, base=(204, 164, 116), second=(178, 128, 88), seed=150 + 10 * k)
        bodies.append(Body(box(1.3, 1.92, 0.12).moved((x, 0.25, back)), plaster))
        bodies.append(Body(half_disc.moved((x, 2.17, back), tilt_deg=90.0), plaster))
    return bodies


def _side_walls() -> list[Body]:
    bodies = []
    for side in (-1.0, 1.0):
        seed = 400 + int(10 * side)
        bodies += [
            Body(box(0.5, 1.1, 6.4).moved((5.0 * side, 0.0, 0.5)), replace(BRICK, seed=seed)),
            Body(box(0.66, 0.12, 6.5).moved((5.0 * side, 1.1, 0.5)), replace(SANDSTONE, seed=seed)),
        ]
        for z in (-0.6, 1.4, 3.4):
            bodies.append(Body(ball(0.24).moved((5.0 * side, 1.42, z)), replace(LIMESTONE, seed=seed + round(z))))
    return bodies


def _pedestal() -> list[Body]:
    steps = [(2.1, 0.0, 0.18, 0.0), (1.6, 0.18, 0.16, 0.0), (1.15, 0.34, 0.16, 0.0)]
    bodies = [
        Body(box(w, h, w, spacing=0.1).moved((0.0, y, 0.0), turn_deg=turn), replace(LIMESTONE, seed=600 + k))
        for k, (w, y, h, turn) in enumerate(steps)
    ]
    profile = _points(
        (0.0, 0.0),
        (0.42, 0.0),
        (0.42, 0.08),
        (0.33, 0.14),
        (0.3, 0.2),
        (0.3, 0.68),
        (0.4, 0.76),
        (0.4, 0.86),
        (0.0, 0.86),
    )
    drum = revolved(profile, segments=8, sharp=True)
    return [*bodies, Body(drum.moved((0.0, 0.5, 0.0), turn_deg=22.5), GREEN_MARBLE)]


def _amphora(foot: float) -> list[Body]:
    knots = _points((0.0, 0.0), (0.15, 0.0), (0.15, 0.03), (0.08, 0.07), (0.13, 0.16), (0.25, 0.36), (0.31, 0.56), (0.29, 0.72),
                    (0.19, 0.86), (0.105, 0.95), (0.1, 1.06), (0.13, 1.13), (0.18, 1.16), (0.16, 1.19), (0.09, 1.15), (0.07, 0.9))  # fmt: skip
    body = revolved(_smoothed(knots, 6), segments=128)
    # an open ring, turned so that its gap faces -x, then stood up
    handle = (
        torus(0.19, 0.026, span_deg=220.0).moved((0.0, 0.0, 0.0), turn_deg=-110.0).moved((0.0, 0.0, 0.0), tilt_deg=90.0)
    )
    glaze = replace(POTTERY, pattern="stone", base=(60, 46, 40), second=(150, 84, 46), scale=0.15)
    left = handle.moved((0.0, 0.0, 0.0), turn_deg=180.0).moved((-0.19, foot + 0.93, 0.0))
    return [
        Body(body.moved((0.0, foot, 0.0)), POTTERY),
        Body(handle.moved((0.19, foot + 0.93, 0.0)), glaze),
        Body(left, glaze),
    ]


def _odd_things() -> list[Body]:
    drum = revolved(
        _points((0.0, 0.0), (0.27, 0.0), (0.27, 0.62), (0.0, 0.62)), segments=96, sharp=True, flutes=(16, 0.08)
    )
    pot = revolved(
        _points(
            (0.0, 0.0), (0.22, 0.0), (0.34, 0.5), (0.39, 0.5), (0.39, 0.58), (0.33, 0.58), (0.31, 0.52), (0.0, 0.52)
        ),
        sharp=True,
    )
    bodies = [
        Body(ball(0.36).moved((-1.75, 0.36, 1.2), turn_deg=20.0, tilt_deg=30.0), MARBLE),
        Body(ball(0.2).moved((-1.15, 0.2, 1.75), tilt_deg=70.0), PAINT),
        Body(box(0.8, 0.62, 0.62, spacing=0.08).moved((1.85, 0.0, 0.55), turn_deg=28.0), WOOD),
        Body(box(0.44, 0.36, 0.4, spacing=0.08).moved((1.8, 0.62, 0.5), turn_deg=-15.0), replace(WOOD, seed=50)),
        Body(torus(0.34, 0.11).moved((1.42, 0.39, 1.15), turn_deg=28.0, tilt_deg=68.0), replace(SANDSTONE, scale=0.2)),
        Body(drum.moved((0.75, 0.27, 2.0), turn_deg=65.0, tilt_deg=90.0), replace(LIMESTONE, seed=620)),
        Body(box(0.5, 0.3, 0.36).moved((-0.55, 0.0, 2.1), turn_deg=-20.0), replace(BRICK, scale=0.1, seed=77)),
    ]
    for k, x in enumerate((-2.9, 2.95)):
        bush = ball(0.55, bumps=0.09, seed=k).moved((x, 0.98, -1.3))
        bodies += [
            Body(pot.moved((x, 0.0, -1.3)), replace(TERRACOTTA, seed=700 + k)),
            Body(bush, replace(LEAVES, seed=800 + k)),
        ]
    return bodies


def _points(*rows: tuple[float, float]) -> FloatArray:
    return np.array(rows, dtype=np.float64)


def _smoothed(knots: FloatArray, steps: int) -> FloatArray:
    # Catmull-Rom through the knots, ends doubled
    p = np.concatenate([knots[:1], knots, knots[-1:]])
    u = np.linspace(0.0, 1.0, steps, endpoint=False)[None, :, None]
    a, b, c, d = (p[k : len(p) - 3 + k, None] for k in range(4))
    curve = 0.5 * (2 * b + (c - a) * u + (2 * a - 5 * b + 4 * c - d) * u**2 + (3 * b - a - 3 * c + d) * u**3)
    points = np.concatenate([curve.reshape(-1, 2), knots[-1:]])
    return np.column_stack([np.maximum(points[:, 0], 0.0), points[:, 1]])
