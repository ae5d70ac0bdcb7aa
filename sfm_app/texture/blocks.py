"""Blocks of a large surface: each has its own pages, so that few pages are in memory while photos are painted."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.culling import morton_order
from sfm_app.settings import TextureSettings
from sfm_app.texture.charts import Charts
from sfm_app.texture.facets import NONE, Facets, IntArray
from sfm_app.texture.packing import Layout, pack
from sfm_app.texture.unseen_faces import block_sizes, squares

IndexArray = NDArray[np.int64]

TRIANGLES = 400_000
"""Triangles of a block. Chosen by hand: twice what a mesh has by default, so that those have one."""


def block_of_faces(mesh: Facets) -> IntArray:
    """Return the block of each triangle, (T,): equal parts of neighbors along the Morton curve.

    Args:
        mesh: the surface.
    """
    count = len(mesh.faces)
    blocks = max(1, -(-count // TRIANGLES))
    found = np.empty(count, np.int32)
    found[mesh.clusters.order] = np.arange(count) * blocks // max(count, 1)
    return found


def lay_out(
    charts: Charts, block_of: IntArray, mesh: Facets, options: TextureSettings
) -> tuple[Layout, IndexArray, IntArray]:
    """Give every block its own pages: place its charts and the squares of the triangles that no photo sees.

    Args:
        charts: none of them in two blocks.
        block_of: (T,) block of each triangle.
        mesh: the surface.
        options: size of pages, and their number for each block.

    Returns:
        The layout; (U, 3) page, x and y of the squares of the triangles without a chart; and (P,) block of each page.
    """
    unseen = np.flatnonzero(charts.chart_of_face == NONE)
    faces = [np.flatnonzero(block_of == block) for block in range(int(block_of.max(initial=0)) + 1)]
    parts = [_part(charts, own) for own in faces]
    rests = [block_sizes(int((part.chart_of_face == NONE).sum())) for _, part in parts]
    packed = [
        pack(part, rest, options.max_atlas_px, options.max_pages) for (_, part), rest in zip(parts, rests, strict=True)
    ]
    scale = min(layout.scale for layout, _ in packed)
    page, shift = np.full(len(charts.photo), NONE, np.int32), np.zeros((len(charts.photo), 2), np.int32)
    cells, sizes, owners = np.empty((len(unseen), 3), np.int64), list[tuple[int, int]](), list[int]()
    for block, ((which, part), rest, found) in enumerate(zip(parts, rests, packed, strict=True)):
        fits = found[0].scale == scale
        layout, places = found if fits else pack(part, rest, options.max_atlas_px, options.max_pages, scale)
        page[which], shift[which] = layout.page + len(sizes), layout.shift
        own = np.flatnonzero(block_of[unseen] == block)
        order = morton_order(mesh.vertices[mesh.faces[unseen[own]]].mean(axis=1))
        cells[own[order]] = squares(places + np.array([len(sizes), 0, 0]), rest, len(own))
        sizes += layout.sizes
        owners += [block] * len(layout.sizes)
    return Layout(page, shift, scale, tuple(sizes)), cells, np.array(owners, np.int32)


def _part(charts: Charts, faces: IndexArray) -> tuple[IndexArray, Charts]:
    """Return the numbers of the charts of a block, and these charts with the triangles of the block."""
    of = charts.chart_of_face[faces]
    which = np.unique(of[of != NONE])
    own = np.where(of == NONE, NONE, np.searchsorted(which, of)).astype(np.int32)
    return which, replace(charts, chart_of_face=own, photo=charts.photo[which], corners=charts.corners[faces])
