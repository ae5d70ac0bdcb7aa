"""Draw random scenes: objects strewn on the ground, identical objects in two places, repeating panels, a wall."""

from dataclasses import replace

import numpy as np

from sfm_app.synthetic.scenes.bodies import Body, SyntheticScene
from sfm_app.synthetic.scenes.courtyard import (
    BRICK,
    GREEN_MARBLE,
    LEAVES,
    LIMESTONE,
    MARBLE,
    PAINT,
    PAVING,
    PLASTER,
    SANDSTONE,
    TERRACOTTA,
    WOOD,
)
from sfm_app.synthetic.scenes.shapes import Shape, ball, box, ground, revolved, torus
from sfm_app.synthetic.scenes.textures import Material

Random = np.random.Generator
OF_THINGS = (WOOD, MARBLE, PAINT, TERRACOTTA, GREEN_MARBLE, LEAVES, LIMESTONE, BRICK)
OF_GROUNDS = (PAVING, LEAVES, SANDSTONE)
OF_WALLS = (MARBLE, GREEN_MARBLE, PLASTER, SANDSTONE, BRICK)
TWIN_X = 1.7
"""Identical objects stand at this distance to the left and right."""


def heap_of_things(rng: Random) -> tuple[Body, ...]:
    """Return boxes, balls, rings and drums about the origin, on a ground; half of the scenes have a wall behind."""
    floor = Body(ground((-4.5, 4.5), (-3.5, 5.5), float(rng.uniform(0.0, 0.08)), spacing=0.15), _of(OF_GROUNDS, rng))
    bodies = [floor]
    for _ in range(int(rng.integers(7, 19))):
        x, z = rng.uniform((-2.2, -1.8), (2.2, 1.2))
        bodies.append(Body(_thing(rng).moved((x, 0.0, z), turn_deg=rng.uniform(0.0, 360.0)), _of(OF_THINGS, rng)))
    if rng.uniform() < 0.5:
        bodies.append(Body(box(9.0, 3.2, 0.2).moved((0.0, -0.1, float(rng.uniform(-3.2, -2.2)))), _of(OF_WALLS, rng)))
    return tuple(bodies)


def twins(rng: Random) -> tuple[Body, ...]:
    """Return two or three objects, each in two places with identical texture."""
    bodies = []
    for k in range(int(rng.integers(2, 4))):
        thing = _thing(rng, size=(0.6, 1.0)).moved((0.5 * (k - 1), 0.0, 0.5 * (k % 2)), turn_deg=rng.uniform(0.0, 90.0))
        copies = [thing.moved((side * TWIN_X, 0.0, 1.0)) for side in (-1.0, 1.0)]
        bodies.append(Body(alike(copies), _of(OF_THINGS, rng)))
    return tuple(bodies)


def panelled(rng: Random) -> tuple[Body, ...]:
    """Return a wall of panels with identical texture, so that features match in every panel."""
    side, gap = float(rng.uniform(0.5, 0.9)), 0.08
    panel = box(side, side, 0.08, spacing=0.1)
    columns = [(k - 3.5) * (side + gap) for k in range(8)]
    copies = [panel.moved((x, 0.1 + row * (side + gap), -2.0)) for x in columns for row in range(3)]
    return (Body(alike(copies), _of(OF_THINGS, rng)),)


def wall(rng: Random) -> SyntheticScene:
    """Return a scene with only a flat wall that faces +z."""
    return SyntheticScene("wall", (Body(box(11.0, 7.0, 0.1).moved((0.0, -2.2, -0.1)), _of(OF_WALLS, rng)),))


def moving_thing(rng: Random) -> tuple[Body, ...]:
    """Return an object about the size of a child, with its origin at its foot."""
    size = float(rng.uniform(0.7, 1.3))
    body = box(0.5 * size, 0.75 * size, 0.4 * size, spacing=0.08)
    head = ball(0.2 * size, bumps=0.1, seed=int(rng.integers(100))).moved((0.0, 0.9 * size, 0.0))
    return Body(body, _finer(_of(OF_THINGS, rng), 0.6)), Body(head, _finer(_of(OF_THINGS, rng), 0.6))


def alike(copies: list[Shape]) -> Shape:
    """Join shapes into one that keeps their texture coordinates, so that equal shapes look equal."""
    starts = np.cumsum([0, *(len(copy.vertices) for copy in copies)])
    faces = [copy.faces + start for copy, start in zip(copies, starts[:-1], strict=True)]
    return Shape(
        np.concatenate([copy.vertices for copy in copies]),
        np.concatenate(faces),
        np.concatenate([copy.normals for copy in copies]),
        np.concatenate([copy.texture for copy in copies]),
    )


def faded(scene: SyntheticScene, strength: float) -> SyntheticScene:
    """Return the scene with less color contrast, and thus few features.

    Args:
        scene: the original.
        strength: share in [0, 1] of the contrast that is kept.
    """
    return replace(scene, bodies=tuple(Body(body.shape, _pale(body.material, strength)) for body in scene.bodies))


def _thing(rng: Random, size: tuple[float, float] = (0.3, 0.9)) -> Shape:
    """Return a random object that stands on y = 0 around the y axis."""
    width, height, depth = rng.uniform(*size, 3)
    kind = int(rng.integers(4))
    if kind == 0:
        return box(width, height, depth, spacing=0.1)
    if kind == 1:
        return ball(0.5 * width, bumps=0.08 * float(rng.integers(2)), seed=int(rng.integers(100))).moved(
            (0.0, 0.5 * width, 0.0)
        )
    if kind == 2:
        return torus(0.5 * width, 0.15 * width).moved((0.0, 0.65 * width, 0.0), tilt_deg=float(rng.uniform(60.0, 90.0)))
    profile = np.array([[0.0, 0.0], [0.5 * width, 0.0], [0.35 * width, 0.6 * height], [0.45 * width, height]])
    return revolved(np.concatenate([profile, [[0.0, height]]]), segments=48, sharp=True)


def _of(materials: tuple[Material, ...], rng: Random) -> Material:
    material = materials[int(rng.integers(len(materials)))]
    return _finer(material, float(rng.uniform(0.6, 1.4)))


def _finer(material: Material, factor: float) -> Material:
    return replace(material, scale=material.scale * factor)


def _pale(material: Material, strength: float) -> Material:
    def nearer(color: tuple[int, int, int]) -> tuple[int, int, int]:
        r, g, b = (round(base + strength * (own - base)) for own, base in zip(color, material.base, strict=True))
        return r, g, b

    return replace(
        material, second=nearer(material.second), joint=nearer(material.joint), contrast=strength * material.contrast
    )
