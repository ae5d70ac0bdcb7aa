"""Surfaces that are easy to count."""

import numpy as np
import pytest

from sfm_app.synthetic.shapes import grid
from sfm_app.types import Surface


def make_sheet(size: int, origin=(0.0, 0.0, 0.0)) -> Surface:
    """A square grid of size x size cells of side 1 in the plane z = 0, facing +z."""
    places, faces = grid(np.arange(size + 1.0), np.arange(size + 1.0))
    colors = (np.arange(3 * len(places)).reshape(-1, 3) % 256).astype(np.uint8)
    return Surface(np.column_stack([places, np.zeros(len(places))]) + origin, faces, colors)


def join(*parts: Surface) -> Surface:
    """Surfaces side by side in one."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    return Surface(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)]),
        np.concatenate([part.colors for part in parts]),
    )


@pytest.fixture(scope="session")
def sheet():
    return make_sheet


@pytest.fixture(scope="session")
def together():
    return join
