"""The plan of a texture, and its pages painted block by block."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.texture.appearance.sightings import Sightings
from sfm_app.texture.atlas import Pages
from sfm_app.texture.blending import Blend
from sfm_app.texture.charts import Charts
from sfm_app.texture.facets import NONE, Facets, IntArray
from sfm_app.texture.packing import Layout
from sfm_app.texture.painting import canvas, finish_page, paint
from sfm_app.texture.store import Store
from sfm_app.texture.views import PhotoView

FloatArray = NDArray[np.float64]
Page = tuple[NDArray[np.uint8], NDArray[np.bool_]]
"""Colors (H, W, 3), and (H, W) whether a texel has one."""
ParallelMap = Callable[[Callable[[Any], Any], Sequence[Any], str], list[Any]]
"""Applies a function to all items, possibly in parallel, and returns results in order; the label names the progress."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedViews:
    """The views of triangles, weighted by sharpness, with gains and outliers."""

    all: Sightings
    """Negative worth for outliers, which show something other than the surface."""
    gains: FloatArray
    """(P, 3)"""
    outliers: int
    """Number of outliers: views of triangles that show something other than the surface."""


@dataclass(frozen=True, slots=True, eq=False)
class TexturePlan:
    """Everything that is computed before photos are painted."""

    mesh: Facets
    seen: CheckedViews
    chosen: IntArray
    """(T,) photo of each triangle, -1 for none."""
    charts: Charts
    layout: Layout
    corners: FloatArray
    """(T, 3, 2) corners in texels, of the triangles that photos see."""
    page: IntArray
    """(T,) page of each triangle."""
    block_of_page: IntArray
    """(G,) block of each page."""
    squares: NDArray[np.int64]
    """(U, 3) page, x, y of the squares of the triangles that no photo sees."""
    blend: Blend
    allowed_weight: NDArray[np.float32]
    """(T, 3) sum of weights at each corner over the photos that may be used for the triangle."""


def paint_blocks(
    plan: TexturePlan, views: Sequence[PhotoView], store: Store, spread: ParallelMap, readable: Sequence[bool]
) -> list[Page]:
    """Paint all pages; only those of one block are in memory with their sums.

    Args:
        plan: where every triangle lies, and what each photo contributes.
        views: the photos.
        store: reads photos, and keeps finished blocks.
        spread: applies a function to all photos.
        readable: (P,) whether a photo can be read.
    """
    found = list[Page]()
    blocks = int(plan.block_of_page.max(initial=0)) + 1
    touched = _blocks_of_photos(plan) if blocks > 1 else None
    for block in range(blocks):
        numbers = np.flatnonzero(plan.block_of_page == block).tolist()
        photos = [p for p, can in enumerate(readable) if can and (touched is None or block in touched[p])]
        kept = store.recall(f"block{block}") if blocks > 1 else None
        if kept is not None:
            found += [(kept[f"page{number}"], kept[f"mask{number}"]) for number in numbers]
            continue
        pages = Pages([_new_canvas(number, plan, spread) for number in numbers], len(views), store, block)
        work = partial(_paint_photo, plan=plan, numbers=numbers, views=views, store=store, pages=pages)
        spread(work, photos, "painting" if blocks == 1 else f"painting block {block + 1} of {blocks}")
        done = [finish_page(page) for page in pages.canvases]
        if blocks > 1:
            colors = {f"page{number}": page for number, (page, _) in zip(numbers, done, strict=True)}
            masks = {f"mask{number}": mask for number, (_, mask) in zip(numbers, done, strict=True)}
            store.keep(f"block{block}", colors | masks)
        found += done
    return found


def _new_canvas(number: int, plan: TexturePlan, spread: ParallelMap) -> Any:
    own = np.flatnonzero((plan.page == number) & (plan.chosen != NONE))
    size = plan.layout.sizes[number]
    return canvas(size, own, plan.corners, lambda claim, bands: spread(claim, bands, "dividing a page"))


def _blocks_of_photos(plan: TexturePlan) -> list[set[int]]:
    """Return for each photo the blocks on whose pages it may appear."""
    found = []
    for photo in range(plan.seen.all.photos):
        near = plan.mesh.faces_at(plan.blend.vertex[plan.blend.photo_rows(photo)])
        pages = np.union1d(plan.page[near], plan.page[plan.chosen == photo])
        found.append(set(plan.block_of_page[pages].tolist()))
    return found


def _paint_photo(
    photo: int, plan: TexturePlan, numbers: Sequence[int], views: Sequence[PhotoView], store: Store, pages: Pages
) -> None:
    """Add one photo to the pages of a block, unless they contain it; photos are read in parallel, painted in turn."""
    if pages.has[photo]:
        return
    triangles, shares = _shares(photo, plan)
    here = np.isin(plan.page[triangles], numbers)
    triangles, shares = triangles[here], shares[here]
    if not len(triangles):
        return
    beside = plan.mesh.neighbors[triangles]
    rims = (beside == NONE) | (plan.seen.all.find(photo, beside) == NONE)
    view, scale = views[photo], plan.layout.scale
    if scale < 1.0:
        view = view.with_size(max(1, round(view.width * scale)), max(1, round(view.height * scale)))
    pixels, points = store.photo(view), plan.mesh.vertices[plan.mesh.faces[triangles]]
    with pages.lock_canvases(photo) as canvases:
        for number, page in zip(numbers, canvases, strict=True):
            there = plan.page[triangles] == number
            what = triangles[there], plan.corners, points[there], shares[there], rims[there]
            paint(pixels, view.row, 1.0 / plan.seen.gains[photo], *what, page.owner, page.total)


def _shares(photo: int, plan: TexturePlan) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the triangles that a photo contributes to, and its weight and offsets (N, 3, 4) at their corners."""
    mesh, part = plan.mesh, plan.blend.photo_rows(photo)
    weight = np.zeros(len(mesh.vertices), np.float32)
    offset = np.zeros((len(mesh.vertices), 3), np.float32)
    weight[plan.blend.vertex[part]], offset[plan.blend.vertex[part]] = plan.blend.weight[part], plan.blend.offset[part]
    near = np.union1d(np.flatnonzero(plan.chosen == photo), mesh.faces_at(plan.blend.vertex[part]))
    own = plan.chosen[near] == photo
    allowed = (plan.seen.all.is_usable(photo, near) | own) & (plan.chosen[near] != NONE)
    shares = np.where(allowed[:, None], weight[mesh.faces[near]], 0.0)
    whole = plan.allowed_weight[near]
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = np.where(whole > 0, shares / whole, own[:, None]).astype(np.float32)
    some = (shares > 0).any(axis=1)
    return near[some], np.concatenate([shares[some][:, :, None], offset[mesh.faces[near[some]]]], axis=2)
