"""Paint the pages of a texture."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.charts import MARGIN, Charts, Layout
from sfm_app.texture.facets import NONE, Facets, IntArray
from sfm_app.texture.seams import Blend
from sfm_app.texture.sightings import Sightings
from sfm_app.texture.views import PhotoView, project, sample
from sfm_app.types.arrays import FloatArray

# The interface for reading photos and for keeping intermediate results of a run.


class Store(Protocol):
    """Reads photos, and keeps arrays by name; kept arrays come from the same inputs and settings and can be reused."""

    def photo(self, view: PhotoView, /) -> NDArray[np.uint8]:
        """Return (height, width, 3) RGB of a view at the view's size; OSError where it cannot be read."""

    def usable_pixels(self, view: PhotoView, /) -> NDArray[np.bool_] | None:
        """Return (height, width) which pixels of a photo at full size may be used; None if all may.

        The other pixels have the color of a usable pixel in `photo`. OSError where the mask cannot be read.
        """

    def recall(self, name: str, /) -> Mapping[str, NDArray[Any]] | None:
        """Return the arrays kept under a name; None if there are none."""

    def keep(self, name: str, /, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays under a name, replacing previous ones, complete or not at all.

        Args:
            name: of the group of arrays.
            arrays: by name.
        """


# Painting of photos onto the texels of the pages.
#
# First every texel gets an owner: the triangle that contains it or, in the margin of a chart, the nearest one. Then
# each photo adds its share to the texels of the triangles that it contributes to. The texel's point on the surface
# is projected through pose and lens, and the photo is sampled there, so photos are resampled only once.

Spread = Callable[[Callable[[int], Any], Sequence[int]], Iterable[Any]]
"""Calls a function for every number, possibly in parallel, and returns the results in order."""

BAND = 512
"""Rows of a page whose texels get owners at once. Chosen by hand: a few for each of two workers."""
LEVELS_PER_GRAY = 256
INSET_PX, MOST_INSET = 1.5, 0.3
"""At an edge where the visible surface ends, pixels mix with the background. Texels closer to it than this distance in
texels, or this share of the triangle's height, repeat the color at that distance."""
NO_LIMIT = -9.0


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """A page that is being painted."""

    owner: IntArray
    """(H, W) triangle that a texel belongs to, -1 for none."""
    total: IntArray
    """(H, W, 3) weighted sum over photos, in 1 / FINE gray levels; sums of integers do not depend on the order."""


def canvas(size: tuple[int, int], triangles: NDArray[np.int64], corners: FloatArray, spread: Spread = map) -> Canvas:
    """Make an empty page whose texels have owners.

    Args:
        size: (width, height) of the page.
        triangles: (N,) indices of the page's triangles.
        corners: (T, 3, 2) texels.
        spread: applies a function to parts of the page, possibly in parallel.
    """
    return Canvas(owners(size, triangles, corners, spread), np.zeros((size[1], size[0], 3), np.int32))


def owners(size: tuple[int, int], triangles: NDArray[np.int64], corners: FloatArray, spread: Spread = map) -> IntArray:
    """Return (H, W) the triangle that each texel belongs to, -1 for none.

    Args:
        size: (width, height) of the page.
        triangles: (N,) indices of the page's triangles.
        corners: (T, 3, 2) texels.
        spread: applies a function to parts of the page, possibly in parallel.
    """
    owner = np.full((size[1], size[0]), NONE, np.int32)

    def claim(top: int) -> None:
        band = owner[top : top + BAND]  # who owns a texel does not depend on the others
        _claim_texels(triangles, corners, top, 0.0, band)
        for margin in range(1, MARGIN + 1):
            _claim_texels(triangles, corners, top, margin - 0.5, band)

    for _ in spread(claim, range(0, size[1], BAND)):
        pass
    return owner


@kernel
def _claim_texels(triangles: NDArray[np.int64], corners: FloatArray, top: int, reach: float, owner: IntArray) -> None:
    """Claim free texels within `reach` of each triangle, in a band of a page; `top` is its first row."""
    height, width = owner.shape
    for f in triangles:
        ax, ay = corners[f, 0, 0], corners[f, 0, 1]
        bx, by = corners[f, 1, 0], corners[f, 1, 1]
        cx, cy = corners[f, 2, 0], corners[f, 2, 1]
        y0, y1 = max(int(min(ay, by, cy) - reach - 0.5), top), min(int(max(ay, by, cy) + reach + 0.5), top + height - 1)
        x0, x1 = max(int(min(ax, bx, cx) - reach - 0.5), 0), min(int(max(ax, bx, cx) + reach + 0.5), width - 1)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if owner[y - top, x] == NONE and _distance(corners[f], x + 0.5, y + 0.5) <= reach:
                    owner[y - top, x] = f


@kernel
def _distance(corner: FloatArray, x: float, y: float) -> float:
    """Return the distance from a point to a triangle; 0 inside."""
    turn = (corner[1, 0] - corner[0, 0]) * (corner[2, 1] - corner[0, 1])
    turn -= (corner[1, 1] - corner[0, 1]) * (corner[2, 0] - corner[0, 0])
    sign = 1.0 if turn >= 0.0 else -1.0
    inside, nearest = turn != 0.0, np.inf
    for k in range(3):
        ax, ay = corner[k, 0], corner[k, 1]
        ex, ey = corner[(k + 1) % 3, 0] - ax, corner[(k + 1) % 3, 1] - ay
        inside = inside and sign * (ex * (y - ay) - ey * (x - ax)) >= 0.0
        length = ex * ex + ey * ey
        along = ((x - ax) * ex + (y - ay) * ey) / length if length > 0.0 else 0.0
        along = min(max(along, 0.0), 1.0)
        nearest = min(nearest, np.hypot(x - ax - along * ex, y - ay - along * ey))
    return 0.0 if inside else nearest


@kernel
def paint(
    photo: NDArray[np.uint8],
    camera: FloatArray,
    brightness: FloatArray,
    triangles: NDArray[np.int64],
    corners: FloatArray,
    points: FloatArray,
    shares: NDArray[np.float32],
    rims: NDArray[np.bool_],
    owner: IntArray,
    total: IntArray,
) -> None:
    """Add one photo to a page.

    Args:
        photo: (height, width, 3) RGB.
        camera: (26,) lens and pose of the photo at this size.
        brightness: (3,) factors, the inverse of the photo's gains.
        triangles: (N,) indices of the page's triangles that the photo contributes to.
        corners: (T, 3, 2) texels.
        points: (N, 3, 3) corners in the scene.
        shares: (N, 3, 4) weight of the photo at each corner, and offsets of its channels in gray levels.
        rims: (N, 3) whether the photo sees no triangle across the edge from corner k to k + 1.
        owner: (H, W) of the page.
        total: (H, W, 3) of the page.
    """
    height, width = owner.shape
    part, least = np.empty(3), np.empty(3)
    for n in range(len(triangles)):
        f = triangles[n]
        ax, ay = corners[f, 0, 0], corners[f, 0, 1]
        bx, by = corners[f, 1, 0] - ax, corners[f, 1, 1] - ay
        cx, cy = corners[f, 2, 0] - ax, corners[f, 2, 1] - ay
        _set_insets(corners[f], rims[n], abs(bx * cy - by * cx), least)
        x0, x1 = int(min(0.0, bx, cx) + ax - MARGIN - 1), int(max(0.0, bx, cx) + ax + MARGIN + 1)
        y0, y1 = int(min(0.0, by, cy) + ay - MARGIN - 1), int(max(0.0, by, cy) + ay + MARGIN + 1)
        for y in range(max(y0, 0), min(y1, height - 1) + 1):
            for x in range(max(x0, 0), min(x1, width - 1) + 1):
                if owner[y, x] != f:
                    continue
                set_shares(corners[f], x + 0.5, y + 0.5, part)
                _clamp_coordinates(part, least)
                px = part[0] * points[n, 0, 0] + part[1] * points[n, 1, 0] + part[2] * points[n, 2, 0]
                py = part[0] * points[n, 0, 1] + part[1] * points[n, 1, 1] + part[2] * points[n, 2, 1]
                pz = part[0] * points[n, 0, 2] + part[1] * points[n, 1, 2] + part[2] * points[n, 2, 2]
                u, v, _ = project(camera, px, py, pz)
                _add(photo, brightness, (u, v), part, shares[n], total[y, x])


@kernel
def set_shares(corner: FloatArray, x: float, y: float, part: FloatArray) -> None:
    """Set the barycentric coordinates of a texel, which may lie in the margin of its triangle.

    Args:
        corner: (3, 2) corners of the triangle in texels.
        x, y: center of the texel.
        part: (3,) is set.
    """
    ax, ay = corner[0, 0], corner[0, 1]
    bx, by, cx, cy = corner[1, 0] - ax, corner[1, 1] - ay, corner[2, 0] - ax, corner[2, 1] - ay
    turn, dx, dy = bx * cy - by * cx, x - ax, y - ay
    part[1] = (dx * cy - dy * cx) / turn if turn != 0.0 else 0.0
    part[2] = (bx * dy - by * dx) / turn if turn != 0.0 else 0.0
    # margins of thin triangles must not be extrapolated far
    part[1], part[2] = min(max(part[1], -1.0), 2.0), min(max(part[2], -1.0), 2.0)
    part[0] = 1.0 - part[1] - part[2]


@kernel
def _add(
    photo: NDArray[np.uint8],
    brightness: FloatArray,
    position: tuple[float, float],
    part: FloatArray,
    share: NDArray[np.float32],
    texel: IntArray,
) -> None:
    """Add the color of a photo at a position to a texel, with weight and offset clamped to the triangle."""
    inner = 0.0
    for k in range(3):
        part[k] = max(part[k], 0.0)
        inner += part[k]
    weight = (part[0] * share[0, 0] + part[1] * share[1, 0] + part[2] * share[2, 0]) / inner
    if weight <= 0.0:
        return
    for channel in range(3):
        value = brightness[channel] * sample(photo, position[0], position[1], channel)
        for k in range(3):
            value += part[k] / inner * share[k, 1 + channel]
        texel[channel] += int(np.floor(LEVELS_PER_GRAY * weight * value + 0.5))


@kernel
def _set_insets(corner: FloatArray, rim: NDArray[np.bool_], double_area: float, least: FloatArray) -> None:
    """Set lower bounds of barycentric coordinates that keep texels away from rims; other edges have none."""
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        length = np.hypot(corner[b, 0] - corner[a, 0], corner[b, 1] - corner[a, 1])
        height_px = max(double_area / max(length, 1e-9), 1e-9)
        least[k] = min(INSET_PX / height_px, MOST_INSET) if rim[a] else NO_LIMIT


@kernel
def _clamp_coordinates(part: FloatArray, least: FloatArray) -> None:
    """Raise barycentric coordinates to their lower bounds, and reduce the others so that the sum stays 1."""
    for k in range(3):
        lack = least[k] - part[k]
        if lack > 0.0:
            rest = part[(k + 1) % 3] + part[(k + 2) % 3]
            for j in (k + 1, k + 2):
                part[j % 3] -= lack * part[j % 3] / rest if rest != 0.0 else 0.5 * lack
            part[k] = least[k]


def finish_page(page: Canvas) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the page as 8-bit RGB, black at texels without an owner, and (H, W) whether a texel has one."""
    rounded = np.empty(page.total.shape, np.uint8)
    _round_levels(page.total, rounded)
    return rounded, page.owner != NONE


@kernel
def _round_levels(total: IntArray, rounded: NDArray[np.uint8]) -> None:
    """Fill in the gray levels of weighted sums."""
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            for channel in range(3):
                level = (total[y, x, channel] + LEVELS_PER_GRAY // 2) // LEVELS_PER_GRAY
                rounded[y, x, channel] = min(max(level, 0), 255)


def fill_background(page: NDArray[np.uint8], painted: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Fill texels without an owner with the mean painted color of the smallest block around them that has one.

    The blocks are those of mipmaps, so a page downsampled by a viewer keeps its colors up to the rims of the charts.

    Args:
        page: (H, W, 3) RGB.
        painted: (H, W) whether a texel has an owner.
    """
    if painted.all() or min(page.shape[:2]) < 2:
        return page
    shape = page.shape[0] // 2, page.shape[1] // 2
    means, known = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.bool_)
    _average_blocks(page, painted, means, known)
    filled = page.copy()
    _fill_gaps(fill_background(means, known), painted, filled)
    return filled


@kernel
def _average_blocks(
    page: NDArray[np.uint8], painted: NDArray[np.bool_], means: NDArray[np.uint8], known: NDArray[np.bool_]
) -> None:
    """Fill in the mean painted color of each block of 2 x 2 texels, and whether it has one."""
    for y in range(known.shape[0]):
        for x in range(known.shape[1]):
            count = 0
            for k in range(4):
                count += painted[2 * y + k // 2, 2 * x + k % 2]
            known[y, x] = count > 0
            for channel in range(3):
                total = 0
                for k in range(4):
                    if painted[2 * y + k // 2, 2 * x + k % 2]:
                        total += page[2 * y + k // 2, 2 * x + k % 2, channel]
                means[y, x, channel] = total // max(count, 1)


@kernel
def _fill_gaps(coarse: NDArray[np.uint8], painted: NDArray[np.bool_], page: NDArray[np.uint8]) -> None:
    """Give texels without an owner the color of their block."""
    for y in range(page.shape[0]):
        for x in range(page.shape[1]):
            if not painted[y, x]:
                for channel in range(3):
                    page[y, x, channel] = coarse[
                        min(y // 2, coarse.shape[0] - 1), min(x // 2, coarse.shape[1] - 1), channel
                    ]


# The pages of a texture while photos are painted on them, with periodic checkpoints.

GROUP_NAME = "pages"
EVERY_S = 10.0
"""Shortest time between checkpoints, in seconds; a killed run loses the photos since the last one."""
MOST_OF_THE_TIME = 0.05
"""Largest share of the time spent on checkpoints; large pages are saved less often."""


class Pages:
    """Canvases with sums over photos; sums of integers do not depend on the order of the photos."""

    def __init__(self, canvases: Sequence[Canvas], photos: int, store: Store, block: int = 0) -> None:
        """Fill empty canvases from the checkpoint of a killed run, if it was at this block."""
        self.canvases, self.has = canvases, np.zeros(photos, np.bool_)
        self._store, self._lock, self._block = store, Lock(), block
        kept = store.recall(GROUP_NAME)
        if kept is not None and kept.get("block") == block:
            self.has[:] = kept["has"]
            for number, page in enumerate(canvases):
                page.total[:] = kept[f"page{number}"]
        self._due_s = time.monotonic() + EVERY_S

    @contextmanager
    def lock_canvases(self, photo: int) -> Iterator[Sequence[Canvas]]:
        """Provide the canvases to one photo at a time, and mark it as painted afterwards."""
        with self._lock:
            yield self.canvases
            self.has[photo] = True
            if time.monotonic() >= self._due_s:
                self._keep()

    def _keep(self) -> None:
        start = time.monotonic()
        totals = {f"page{number}": page.total for number, page in enumerate(self.canvases)}
        self._store.keep(GROUP_NAME, {"block": np.array(self._block), "has": self.has, **totals})
        end = time.monotonic()
        self._due_s = end + max(EVERY_S, (end - start) / MOST_OF_THE_TIME)


# The plan of a texture, and its pages painted block by block.

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
