"""Surfaces that are easy to count."""

import numpy as np
import pytest

from sfm_app.types import Surface


def make_sheet(size: int, step: float = 1.0, origin=(0.0, 0.0, 0.0), flipped: bool = False) -> Surface:
    """A square grid of size x size cells in the plane z = 0, facing +z."""
    y, x = np.mgrid[: size + 1, : size + 1]
    vertices = np.stack([x * step, y * step, np.zeros_like(x)], axis=-1).reshape(-1, 3) + origin
    at = np.arange((size + 1) ** 2).reshape(size + 1, size + 1)
    a, b, c, d = (corner.ravel() for corner in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    colors = np.arange(len(vertices) * 3).reshape(-1, 3) % 256
    return Surface(vertices, faces[:, ::-1] if flipped else faces, colors.astype(np.uint8))


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
