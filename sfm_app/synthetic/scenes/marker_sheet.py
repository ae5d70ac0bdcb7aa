"""Lay printed markers into a scene."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.synthetic.scenes.bodies import Body
from sfm_app.synthetic.scenes.shapes import Shape
from sfm_app.synthetic.scenes.textures import Color, Material

INK: Color = (22, 22, 24)
PAPER: Color = (232, 230, 224)


def marker_sheet(
    pattern: NDArray[np.uint8],
    side: float,
    to: tuple[float, float, float],
    turn_deg: float = 0.0,
    tilt_deg: float = 0.0,
) -> tuple[Body, Body]:
    """Return a marker on a sheet of paper, which has a light cell around it: dark cells, and light ones.

    Args:
        pattern: (N, N) cells with the dark border, 0 or 255; its first row is the far one.
        side: of the dark square, in scene units.
        to: where its middle is.
        turn_deg: about y, right-handed; without tilt it lies flat and faces up.
        tilt_deg: about x, right-handed, before the turn; 90: it stands upright and faces z.
    """
    cells = np.pad(pattern > 127, 1, constant_values=True)
    size = side / len(pattern)
    return (
        Body(_squares(~cells, size).move(to, turn_deg, tilt_deg), _plain(INK)),
        Body(_squares(cells, size).move(to, turn_deg, tilt_deg), _plain(PAPER)),
    )


def _squares(chosen: NDArray[np.bool_], size: float) -> Shape:
    """Return the chosen cells of a grid about the origin, flat on y = 0; rows run towards z."""
    places = np.argwhere(chosen)[:, ::-1] - len(chosen) / 2  # x and z of each cell's corner
    corners = np.array([[0, 0], [0, 1], [1, 1], [1, 0]])
    flat = size * (places[:, None] + corners).reshape(-1, 2)
    vertices = np.column_stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]])
    first = 4 * np.arange(len(places), dtype=np.int64)[:, None]
    faces = np.concatenate([first + np.array(half) for half in ([0, 1, 2], [0, 2, 3])])
    return Shape(vertices, faces, np.tile([0.0, 1.0, 0.0], (len(vertices), 1)), vertices)


def _plain(color: Color) -> Material:
    """Return a material of one color."""
    return Material(pattern="ceramic", base=color, second=color, joint=color, contrast=0.0)
