"""Define the bodies that a synthetic scene consists of."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.synthetic.scenes.shapes import Shape
from sfm_app.synthetic.scenes.textures import Material

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Body:
    """One object in a scene. Bodies of one material differ in texture: their index in the scene seeds it."""

    shape: Shape
    material: Material


@dataclass(frozen=True, slots=True)
class SyntheticScene:
    """Bodies under a fixed light; y up, scene units are about meters."""

    name: str
    bodies: tuple[Body, ...]
    to_light: tuple[float, float, float] = (0.45, 0.75, 0.5)
    """Direction towards the sun, any length."""
    sun: float = 0.95
    """Brightness of the sun on a surface that faces it."""
    sky: float = 0.5
    """Brightness of the sky on a surface that faces up."""

    bounced: float = 0.0
    """Share of the sky's light that reaches what sees no sky, such as panes in deep windows; 0..1."""

    thin: tuple[FloatArray, ...] = ()
    """Lines (N, 4) of thin things: points on their axes, and the radius there."""

    @property
    def vertices(self) -> FloatArray:
        """(V, 3) vertices of all bodies."""
        return np.concatenate([body.shape.vertices for body in self.bodies])

    @property
    def faces(self) -> NDArray[np.int64]:
        """(T, 3) vertex indices of all bodies."""
        counts = [len(body.shape.vertices) for body in self.bodies]
        starts = np.cumsum([0, *counts[:-1]])
        return np.concatenate([body.shape.faces + start for body, start in zip(self.bodies, starts, strict=True)])
