"""Pages of a texture: their texels get owners, photos are painted on them, and gaps are filled."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.tasks import ParallelMap, Spread
from sfm_app.texture.charts import MARGIN, Charts, Layout
from sfm_app.texture.seams import Blend
from sfm_app.texture.sightings import NONE, Facets, IntArray, Sightings
from sfm_app.texture.views import PhotoView, project, sample
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

BAND = 512
"""Rows of a page whose texels get owners at once. Chosen by hand: a few for each of two workers."""
LEVELS_PER_GRAY = 256
"""Levels of the integer sums per gray level."""
CHECKPOINT_NAME = "pages"
"""Name of the unfinished pages in the store."""

Page = tuple[NDArray[np.uint8], BoolArray]
"""Colors (H, W, 3), and (H, W) whether a texel has one."""


class Store(Protocol):
    """Reads photos, and keeps arrays by name; kept arrays come from the same inputs and settings and can be reused."""

    def photo(self, view: PhotoView, /) -> NDArray[np.uint8]:
        """Return (height, width, 3) RGB of a view at the view's size; OSError if it cannot be read."""

    def usable_pixels(self, view: PhotoView, /) -> BoolArray | None:
        """Return (height, width) which pixels of a photo at full size may be used; None if all may.

        The other pixels have the color of a usable pixel in `photo`. OSError if the mask cannot be read.
        """

    def recall(self, name: str, /) -> Mapping[str, NDArray[Any]] | None:
        """Return the arrays kept under a name, or None."""

    def keep(self, name: str, /, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep named arrays under one name, in place of earlier ones; all of them or none."""


# First every texel gets an owner: the triangle around it or, in the margin of a chart, the nearest one. Then each
# photo adds its share to the texels of its triangles. The texel's point on the surface is projected through pose and
# lens, and the photo is sampled there, so photos are resampled only once.


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """An unfinished page."""

    owner: IntArray
    """(H, W) triangle of each texel, -1 for none."""
    total: IntArray
    """(H, W, 3) weighted sum over photos, in levels; sums of integers do not depend on the order."""


def owners(
    size: tuple[int, int], triangles: IndexArray, corners: FloatArray, spread: Spread = map, band: int = BAND
) -> IntArray:
    """Return (H, W) the triangle of each texel of a page (W, H), -1 for none; corners (T, 3, 2) are in texels."""
    owner = np.full((size[1], size[0]), NONE, np.int32)

    def claim(top: int) -> None:
        rows = owner[top : top + band]  # owners of texels are independent
        _claim_texels(triangles, corners, top, 0.0, rows)
        for margin in range(1, MARGIN + 1):
            _claim_texels(triangles, corners, top, margin - 0.5, rows)

    for _ in spread(claim, range(0, size[1], band)):
        pass
    return owner


@kernel
def _claim_texels(triangles: IndexArray, corners: FloatArray, top: int, reach: float, owner: IntArray) -> None:
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
def paint(  # noqa: PLR0913
    photo: NDArray[np.uint8],
    camera: FloatArray,
    brightness: FloatArray,
    triangles: IndexArray,
    corners: FloatArray,
    points: FloatArray,
    shares: NDArray[np.float32],
    open_edges: BoolArray,
    owner: IntArray,
    total: IntArray,
) -> None:
    """Add one photo (height, width, 3) to a page, with its camera row at this size.

    `triangles` (N,) are those of the page with a share of the photo, `shares` (N, 3, 4) its weight at each corner and
    the offsets of its channels in gray levels, `open_edges` (N, 3) whether the edge from corner k to k + 1 has no
    visible triangle across. The brightness is the inverse of the gains. Corners (T, 3, 2) are in texels, points
    (N, 3, 3) in the scene.
    """
    height, width = owner.shape
    part, least = np.empty(3), np.empty(3)
    for n in range(len(triangles)):
        f = triangles[n]
        ax, ay = corners[f, 0, 0], corners[f, 0, 1]
        bx, by = corners[f, 1, 0] - ax, corners[f, 1, 1] - ay
        cx, cy = corners[f, 2, 0] - ax, corners[f, 2, 1] - ay
        _set_insets(corners[f], open_edges[n], abs(bx * cy - by * cx), least)
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
    """Set the barycentric coordinates (3,) of a texel in or near a triangle (3, 2)."""
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
def _set_insets(corner: FloatArray, is_open: BoolArray, double_area: float, least: FloatArray) -> None:
    """Set lower bounds of barycentric coordinates that keep texels away from open edges; other edges have none.

    At an open edge, pixels mix with the background. Texels closer to it than half the diagonal of a pixel, or 0.3 of
    the triangle's height, repeat the color at that distance.
    """
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        length = np.hypot(corner[b, 0] - corner[a, 0], corner[b, 1] - corner[a, 1])
        height_px = max(double_area / max(length, 1e-9), 1e-9)
        least[k] = min(0.7 / height_px, 0.3) if is_open[a] else -9.0


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


def _finish_page(page: Canvas) -> Page:
    """Return the page in 8-bit RGB, black at texels without an owner, and (H, W) whether a texel has an owner."""
    rounded = np.empty(page.total.shape, np.uint8)
    _round_levels(page.total, rounded)
    return rounded, page.owner != NONE


@kernel
def _round_levels(total: IntArray, rounded: NDArray[np.uint8]) -> None:
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            for channel in range(3):
                level = (total[y, x, channel] + LEVELS_PER_GRAY // 2) // LEVELS_PER_GRAY
                rounded[y, x, channel] = min(max(level, 0), 255)


def fill_background(page: NDArray[np.uint8], painted: BoolArray) -> NDArray[np.uint8]:
    """Fill unpainted texels with the mean painted color of the smallest block around them, as mipmaps have it."""
    if painted.all() or min(page.shape[:2]) < 2:
        return page
    shape = page.shape[0] // 2, page.shape[1] // 2
    means, known = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.bool_)
    _average_blocks(page, painted, means, known)
    filled = page.copy()
    _fill_gaps(fill_background(means, known), painted, filled)
    return filled


@kernel
def _average_blocks(page: NDArray[np.uint8], painted: BoolArray, means: NDArray[np.uint8], known: BoolArray) -> None:
    """Write the mean painted color of each block of 2 x 2 texels, and whether it has one."""
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
def _fill_gaps(coarse: NDArray[np.uint8], painted: BoolArray, page: NDArray[np.uint8]) -> None:
    for y in range(page.shape[0]):
        for x in range(page.shape[1]):
            if not painted[y, x]:
                for channel in range(3):
                    page[y, x, channel] = coarse[
                        min(y // 2, coarse.shape[0] - 1), min(x // 2, coarse.shape[1] - 1), channel
                    ]


@dataclass(frozen=True, slots=True)
class CheckpointOptions:
    """How often unfinished pages are saved."""

    every_s: float = 10.0
    """Shortest time between checkpoints, in seconds; a killed run loses the photos since the last one."""
    most_time: float = 0.05
    """Largest share of the time spent on checkpoints; large pages are saved less often."""


CHECKPOINTS = CheckpointOptions()


class Pages:
    """The canvases of a block, with checkpoints."""

    def __init__(self, canvases: Sequence[Canvas], photos: int, store: Store, block: int = 0) -> None:
        """Fill empty canvases from the checkpoint of a killed run at the same block."""
        self.canvases, self.has = canvases, np.zeros(photos, np.bool_)
        self._store, self._lock, self._block = store, Lock(), block
        kept = store.recall(CHECKPOINT_NAME)
        if kept is not None and kept.get("block") == block:
            self.has[:] = kept["has"]
            for number, page in enumerate(canvases):
                page.total[:] = kept[f"page{number}"]
        self._due_s = time.monotonic() + CHECKPOINTS.every_s

    @contextmanager
    def lock_canvases(self, photo: int) -> Iterator[Sequence[Canvas]]:
        """Provide the canvases to one photo at a time, then mark it as painted."""
        with self._lock:
            yield self.canvases
            self.has[photo] = True
            if time.monotonic() >= self._due_s:
                self._keep()

    def _keep(self) -> None:
        start = time.monotonic()
        totals = {f"page{number}": page.total for number, page in enumerate(self.canvases)}
        self._store.keep(CHECKPOINT_NAME, {"block": np.array(self._block), "has": self.has, **totals})
        end = time.monotonic()
        self._due_s = end + max(CHECKPOINTS.every_s, (end - start) / CHECKPOINTS.most_time)


@dataclass(frozen=True, slots=True, eq=False)
class CheckedViews:
    """The views of triangles, weighted by sharpness, with gains and outliers."""

    sightings: Sightings
    """With negative scores of outliers."""
    gains: FloatArray
    """(P, 3)"""
    outliers: int
    """Number of views that do not show the surface."""


@dataclass(frozen=True, slots=True, eq=False)
class TexturePlan:
    """Charts, pages and weights of the photos."""

    mesh: Facets
    checked: CheckedViews
    chosen: IntArray
    """(T,) photo of each triangle, -1 for none."""
    charts: Charts
    layout: Layout
    corners: FloatArray
    """(T, 3, 2) corners in texels of triangles with a photo."""
    page: IntArray
    """(T,) page of each triangle."""
    block_of_page: IntArray
    """(G,) block of each page."""
    squares: IndexArray
    """(U, 3) page, x, y of the squares of triangles without a photo."""
    blend: Blend
    allowed_weight: NDArray[np.float32]
    """(T, 3) sum of weights at each corner over the usable photos of the triangle."""


def paint_blocks(
    plan: TexturePlan, views: Sequence[PhotoView], store: Store, spread: ParallelMap, readable: Sequence[bool]
) -> list[Page]:
    """Paint all pages with the readable photos; only the sums of one block are in memory."""
    finished = list[Page]()
    blocks = int(plan.block_of_page.max(initial=0)) + 1
    block_sets = _blocks_of_photos(plan) if blocks > 1 else None
    for block in range(blocks):
        numbers = np.flatnonzero(plan.block_of_page == block).tolist()
        photos = [p for p, can in enumerate(readable) if can and (block_sets is None or block in block_sets[p])]
        kept = store.recall(f"block{block}") if blocks > 1 else None
        if kept is not None:
            finished += [(kept[f"page{number}"], kept[f"mask{number}"]) for number in numbers]
            continue
        pages = Pages([_new_canvas(number, plan, spread) for number in numbers], len(views), store, block)
        work = partial(_paint_photo, plan=plan, numbers=numbers, views=views, store=store, pages=pages)
        spread(work, photos, "painting" if blocks == 1 else f"painting block {block + 1} of {blocks}")
        rounded = [_finish_page(page) for page in pages.canvases]
        if blocks > 1:
            colors = {f"page{number}": page for number, (page, _) in zip(numbers, rounded, strict=True)}
            masks = {f"mask{number}": mask for number, (_, mask) in zip(numbers, rounded, strict=True)}
            store.keep(f"block{block}", colors | masks)
        finished += rounded
    return finished


def _new_canvas(number: int, plan: TexturePlan, spread: ParallelMap) -> Canvas:
    own = np.flatnonzero((plan.page == number) & (plan.chosen != NONE))
    width, height = plan.layout.sizes[number]
    owner = owners(
        (width, height), own, plan.corners, lambda claim, bands: spread(claim, bands, "assigning texels to triangles")
    )
    return Canvas(owner, np.zeros((height, width, 3), np.int32))


def _blocks_of_photos(plan: TexturePlan) -> list[set[int]]:
    block_sets = []
    for photo in range(plan.checked.sightings.photos):
        near = plan.mesh.faces_at(plan.blend.vertex[plan.blend.photo_rows(photo)])
        pages = np.union1d(plan.page[near], plan.page[plan.chosen == photo])
        block_sets.append(set(plan.block_of_page[pages].tolist()))
    return block_sets


def _paint_photo(
    photo: int, plan: TexturePlan, numbers: Sequence[int], views: Sequence[PhotoView], store: Store, pages: Pages
) -> None:
    """Add one photo to the pages of a block, unless they contain it; only reading is parallel."""
    if pages.has[photo]:
        return
    triangles, shares = _shares(photo, plan)
    here = np.isin(plan.page[triangles], numbers)
    triangles, shares = triangles[here], shares[here]
    if not len(triangles):
        return
    beside = plan.mesh.neighbors[triangles]
    open_edges = (beside == NONE) | (plan.checked.sightings.find(photo, beside) == NONE)
    view, scale = views[photo], plan.layout.scale
    if scale < 1.0:
        view = view.resize(max(1, round(view.width * scale)), max(1, round(view.height * scale)))
    pixels, points = store.photo(view), plan.mesh.vertices[plan.mesh.faces[triangles]]
    with pages.lock_canvases(photo) as canvases:
        for number, page in zip(numbers, canvases, strict=True):
            own = plan.page[triangles] == number
            content = triangles[own], plan.corners, points[own], shares[own], open_edges[own]
            paint(pixels, view.row, 1.0 / plan.checked.gains[photo], *content, page.owner, page.total)


def _shares(photo: int, plan: TexturePlan) -> tuple[IndexArray, NDArray[np.float32]]:
    """Return the triangles with a share of a photo, and its weight and offsets (N, 3, 4) at their corners."""
    mesh, part = plan.mesh, plan.blend.photo_rows(photo)
    weight = np.zeros(len(mesh.vertices), np.float32)
    offset = np.zeros((len(mesh.vertices), 3), np.float32)
    weight[plan.blend.vertex[part]], offset[plan.blend.vertex[part]] = plan.blend.weight[part], plan.blend.offset[part]
    near = np.union1d(np.flatnonzero(plan.chosen == photo), mesh.faces_at(plan.blend.vertex[part]))
    own = plan.chosen[near] == photo
    allowed = (plan.checked.sightings.is_usable(photo, near) | own) & (plan.chosen[near] != NONE)
    shares = np.where(allowed[:, None], weight[mesh.faces[near]], 0.0)
    whole = plan.allowed_weight[near]
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = np.where(whole > 0, shares / whole, own[:, None]).astype(np.float32)
    used = (shares > 0).any(axis=1)
    return near[used], np.concatenate([shares[used][:, :, None], offset[mesh.faces[near[used]]]], axis=2)
