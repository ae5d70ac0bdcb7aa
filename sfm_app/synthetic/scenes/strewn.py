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
from sfm_app.synthetic.scenes.shapes import Shape, ball, box, ground, revolve, torus
from sfm_app.synthetic.scenes.textures import Material

Random = np.random.Generator
THING_MATERIALS = (WOOD, MARBLE, PAINT, TERRACOTTA, GREEN_MARBLE, LEAVES, LIMESTONE, BRICK)
GROUND_MATERIALS = (PAVING, LEAVES, SANDSTONE)
WALL_MATERIALS = (MARBLE, GREEN_MARBLE, PLASTER, SANDSTONE, BRICK)
REPEAT_X = 1.7
"""Identical objects stand at this distance to the left and right."""


def heap_of_things(rng: Random) -> tuple[Body, ...]:
    """Return boxes, balls, rings and drums about the origin, on a ground; half of the scenes have a wall behind."""
    floor = Body(
        ground((-4.5, 4.5), (-3.5, 5.5), float(rng.uniform(0.0, 0.08)), spacing=0.15),
        _draw_material(GROUND_MATERIALS, rng),
    )
    bodies = [floor]
    for _ in range(int(rng.integers(7, 19))):
        x, z = rng.uniform((-2.2, -1.8), (2.2, 1.2))
        bodies.append(
            Body(
                _random_thing(rng).move((x, 0.0, z), turn_deg=rng.uniform(0.0, 360.0)),
                _draw_material(THING_MATERIALS, rng),
            )
        )
    if rng.uniform() < 0.5:
        bodies.append(
            Body(
                box(9.0, 3.2, 0.2).move((0.0, -0.1, float(rng.uniform(-3.2, -2.2)))),
                _draw_material(WALL_MATERIALS, rng),
            )
        )
    return tuple(bodies)


def repeated_things(rng: Random) -> tuple[Body, ...]:
    """Return two or three objects, each in two places with identical texture."""
    bodies = []
    for k in range(int(rng.integers(2, 4))):
        thing = _random_thing(rng, size=(0.6, 1.0)).move(
            (0.5 * (k - 1), 0.0, 0.5 * (k % 2)), turn_deg=rng.uniform(0.0, 90.0)
        )
        copies = [thing.move((side * REPEAT_X, 0.0, 1.0)) for side in (-1.0, 1.0)]
        bodies.append(Body(join_copies(copies), _draw_material(THING_MATERIALS, rng)))
    return tuple(bodies)


def panel_wall(rng: Random) -> tuple[Body, ...]:
    """Return a wall of panels with identical texture, so that features match in every panel."""
    side, gap = float(rng.uniform(0.5, 0.9)), 0.08
    panel = box(side, side, 0.08, spacing=0.1)
    columns = [(k - 3.5) * (side + gap) for k in range(8)]
    copies = [panel.move((x, 0.1 + row * (side + gap), -2.0)) for x in columns for row in range(3)]
    return (Body(join_copies(copies), _draw_material(THING_MATERIALS, rng)),)


def wall(rng: Random) -> SyntheticScene:
    """Return a scene with only a flat wall that faces +z."""
    return SyntheticScene(
        "wall", (Body(box(11.0, 7.0, 0.1).move((0.0, -2.2, -0.1)), _draw_material(WALL_MATERIALS, rng)),)
    )


def moving_thing(rng: Random) -> tuple[Body, ...]:
    """Return an object about the size of a child, with its origin at its foot."""
    size = float(rng.uniform(0.7, 1.3))
    body = box(0.5 * size, 0.75 * size, 0.4 * size, spacing=0.08)
    head = ball(0.2 * size, bumps=0.1, seed=int(rng.integers(100))).move((0.0, 0.9 * size, 0.0))
    return Body(body, _with_scaled_pattern(_draw_material(THING_MATERIALS, rng), 0.6)), Body(
        head, _with_scaled_pattern(_draw_material(THING_MATERIALS, rng), 0.6)
    )


def join_copies(copies: list[Shape]) -> Shape:
    """Join shapes into one that keeps their texture coordinates, so that equal shapes look equal."""
    starts = np.cumsum([0, *(len(copy.vertices) for copy in copies)])
    faces = [copy.faces + start for copy, start in zip(copies, starts[:-1], strict=True)]
    return Shape(
        np.concatenate([copy.vertices for copy in copies]),
        np.concatenate(faces),
        np.concatenate([copy.normals for copy in copies]),
        np.concatenate([copy.texture for copy in copies]),
    )


def fade_colors(scene: SyntheticScene, strength: float) -> SyntheticScene:
    """Return the scene with less color contrast, and thus few features.

    Args:
        scene: the original.
        strength: share in [0, 1] of the contrast that is kept.
    """
    return replace(
        scene, bodies=tuple(Body(body.shape, _fade_material(body.material, strength)) for body in scene.bodies)
    )


def _random_thing(rng: Random, size: tuple[float, float] = (0.3, 0.9)) -> Shape:
    """Return a random object that stands on y = 0 around the y axis."""
    width, height, depth = rng.uniform(*size, 3)
    kind = int(rng.integers(4))
    if kind == 0:
        return box(width, height, depth, spacing=0.1)
    if kind == 1:
        return ball(0.5 * width, bumps=0.08 * float(rng.integers(2)), seed=int(rng.integers(100))).move(
            (0.0, 0.5 * width, 0.0)
        )
    if kind == 2:
        return torus(0.5 * width, 0.15 * width).move((0.0, 0.65 * width, 0.0), tilt_deg=float(rng.uniform(60.0, 90.0)))
    profile = np.array([[0.0, 0.0], [0.5 * width, 0.0], [0.35 * width, 0.6 * height], [0.45 * width, height]])
    return revolve(np.concatenate([profile, [[0.0, height]]]), segments=48, sharp=True)


def _draw_material(materials: tuple[Material, ...], rng: Random) -> Material:
    material = materials[int(rng.integers(len(materials)))]
    return _with_scaled_pattern(material, float(rng.uniform(0.6, 1.4)))


def _with_scaled_pattern(material: Material, factor: float) -> Material:
    return replace(material, scale=material.scale * factor)


def _fade_material(material: Material, strength: float) -> Material:
    def fade_color(color: tuple[int, int, int]) -> tuple[int, int, int]:
        r, g, b = (round(base + strength * (own - base)) for own, base in zip(color, material.base, strict=True))
        return r, g, b

    return replace(
        material,
        second=fade_color(material.second),
        joint=fade_color(material.joint),
        contrast=strength * material.contrast,
    )
