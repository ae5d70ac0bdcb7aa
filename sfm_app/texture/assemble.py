"""From a surface and photos to a textured surface: the steps of texturing in order."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.culling import morton_order
from sfm_app.geometry.triangles import select_faces
from sfm_app.settings import TextureSettings
from sfm_app.texture.appearance.exposure import photo_gains
from sfm_app.texture.appearance.photo_consistency import outlier_mask
from sfm_app.texture.appearance.sightings import Sightings, list_sightings
from sfm_app.texture.appearance.view_scoring import FaceView, OcclusionTest, score_faces, sharpness_factors
from sfm_app.texture.atlas import Pages
from sfm_app.texture.blending import Blend, blend_weights
from sfm_app.texture.charts import Charts, absorb_small_charts, make_charts
from sfm_app.texture.facets import NONE, Facets, IntArray, facets
from sfm_app.texture.packing import Layout, pack
from sfm_app.texture.painting import Canvas, canvas, fill_background, finish_page, paint
from sfm_app.texture.seam_leveling import level_seams
from sfm_app.texture.store import Store
from sfm_app.texture.unseen_faces import block_sizes, square_texels, squares, vertex_colors
from sfm_app.texture.view_selection import choose_photos
from sfm_app.texture.views import PhotoView
from sfm_app.types import Model, Rejected, Surface, Texture

FloatArray = NDArray[np.float64]
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
    squares: NDArray[np.int64]
    """(U, 3) page, x, y of the squares of the triangles that no photo sees."""
    blend: Blend
    allowed_weight: NDArray[np.float32]
    """(T, 3) sum of weights at each corner over the photos that may be used for the triangle."""


def texture_surface(
    surface: Surface,
    views: Sequence[PhotoView],
    store: Store,
    hidden: OcclusionTest,
    options: TextureSettings,
    spread: ParallelMap,
) -> tuple[Model, dict[str, Any]]:
    """Paint a surface with photos.

    Args:
        surface: triangles in the frame of the views.
        views: the registered photos.
        store: reads photos, and keeps the results of each, so that a killed run can continue.
        hidden: the occlusion test for this surface.
        options: size and number of pages, and treatment of triangles that no photo sees.
        spread: applies a function to all photos.

    Returns:
        The surface with texture and colors from the photos, cut if the options say so; and figures for the manifest.
    """
    mesh = facets(surface)
    looks = _score_photos(views, mesh, store, hidden, spread)
    seen = _check_views(looks, mesh)
    chosen = absorb_small_charts(choose_photos(seen.all, mesh), seen.all, mesh.neighbors)
    unseen = chosen == NONE
    if options.unseen_faces == "cut" and not unseen.all():
        mesh = facets(select_faces(surface, ~unseen))
        seen, chosen = replace(seen, all=seen.all.among(~unseen)), chosen[~unseen]
    plan = _plan(mesh, seen, chosen, views, options)
    canvases = [
        canvas(size, np.flatnonzero((plan.page == page) & (chosen != NONE)), plan.corners)
        for page, size in enumerate(plan.layout.sizes)
    ]
    pages = Pages(canvases, len(views), store)
    work = partial(_paint_photo, plan=plan, views=views, store=store, pages=pages)
    rejected = [look if isinstance(look, Rejected) else None for look in looks]
    spread(work, [photo for photo, reason in enumerate(rejected) if reason is None], "painting")
    return _finish(plan, canvases), _figures(plan, views, rejected, int(unseen.sum()))


def _score_photos(
    views: Sequence[PhotoView], mesh: Facets, store: Store, hidden: OcclusionTest, spread: ParallelMap
) -> list[FaceView | Rejected]:
    def score(photo: int) -> FaceView | Rejected:
        return _score_photo(f"look{photo}", views[photo], mesh, store, hidden)

    return spread(score, range(len(views)), "looking at the surface")


def _score_photo(name: str, view: PhotoView, mesh: Facets, store: Store, hidden: OcclusionTest) -> FaceView | Rejected:
    kept = store.recall(name)
    if kept is not None:
        return FaceView(kept["face"], kept["worth"], kept["color"], float(kept["sharpness"]))
    try:
        photo, used = store.photo(view), store.usable_pixels(view)
    except OSError as err:
        return Rejected(f"cannot be read: {err.strerror or 'damaged'}")
    found = score_faces(view, photo, used, mesh, hidden)
    arrays = {"face": found.face, "worth": found.worth, "color": found.color}
    store.keep(name, arrays | {"sharpness": np.array(found.sharpness)})
    return found


def _check_views(looks: Sequence[FaceView | Rejected], mesh: Facets) -> CheckedViews:
    """Adjust the worths by sharpness, estimate gains, and mark outliers by negative worths."""
    found = [None if isinstance(look, Rejected) else look for look in looks]
    sharpness = np.array([0.0 if look is None else look.sharpness for look in found])
    read = sharpness > 0
    sharp = np.zeros(len(read))
    sharp[read] = sharpness_factors(sharpness[read])
    seen = list_sightings([look if use else None for look, use in zip(found, read, strict=True)], len(mesh.faces))
    seen = seen.with_worth(seen.worth * sharp[seen.photo].astype(np.float32))
    gains = photo_gains(seen)
    strange = outlier_mask(seen, gains, mesh.neighbors)
    return CheckedViews(seen.with_worth(np.where(strange, -seen.worth, seen.worth)), gains, int(strange.sum()))


def _plan(
    mesh: Facets, seen: CheckedViews, chosen: IntArray, views: Sequence[PhotoView], options: TextureSettings
) -> TexturePlan:
    charts = make_charts(chosen, np.array([view.row for view in views]), mesh, options.max_atlas_px / 2)
    blocks = block_sizes(int((chosen == NONE).sum()))
    layout, places = pack(charts, blocks, options.max_atlas_px, options.max_pages)
    corners, page = charts.corners * layout.scale, np.zeros(len(chosen), np.int32)
    drawn = chosen != NONE
    corners[drawn] += layout.shift[charts.chart_of_face[drawn]][:, None, :]
    page[drawn] = layout.page[charts.chart_of_face[drawn]]
    cells = np.empty((int((~drawn).sum()), 3), np.int64)
    cells[morton_order(mesh.vertices[mesh.faces[~drawn]].mean(axis=1))] = squares(places, blocks, len(cells))
    page[~drawn] = cells[:, 0]
    blend = level_seams(blend_weights(chosen, seen.all, mesh), seen.all, seen.gains, mesh)
    allowed = _allowed_weight(blend, seen.all, chosen, mesh)
    return TexturePlan(mesh, seen, chosen, charts, layout, corners, page, cells, blend, allowed)


def _paint_photo(photo: int, plan: TexturePlan, views: Sequence[PhotoView], store: Store, pages: Pages) -> None:
    """Add one photo to all pages, unless they contain it; photos are read in parallel and painted one at a time."""
    if pages.has[photo]:
        return
    triangles, shares = _shares(photo, plan)
    if not len(triangles):
        return
    beside = plan.mesh.neighbors[triangles]
    rims = (beside == NONE) | (plan.seen.all.find(np.int64(photo), beside) == NONE)
    view, scale = views[photo], plan.layout.scale
    if scale < 1.0:
        view = view.with_size(max(1, round(view.width * scale)), max(1, round(view.height * scale)))
    pixels, points = store.photo(view), plan.mesh.vertices[plan.mesh.faces[triangles]]
    with pages.lock_canvases(photo) as canvases:
        for number, page in enumerate(canvases):
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
    allowed = (plan.seen.all.is_usable(np.int64(photo), near) | own) & (plan.chosen[near] != NONE)
    shares = np.where(allowed[:, None], weight[mesh.faces[near]], 0.0)
    whole = plan.allowed_weight[near]
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = np.where(whole > 0, shares / whole, own[:, None]).astype(np.float32)
    some = (shares > 0).any(axis=1)
    return near[some], np.concatenate([shares[some][:, :, None], offset[mesh.faces[near[some]]]], axis=2)


def _allowed_weight(blend: Blend, seen: Sightings, chosen: IntArray, mesh: Facets) -> NDArray[np.float32]:
    total = np.zeros(mesh.faces.shape, np.float32)
    weight = np.zeros(len(mesh.vertices), np.float32)
    for photo in range(seen.photos):
        part = blend.photo_rows(photo)
        near = mesh.faces_at(blend.vertex[part])
        near = near[seen.is_usable(np.int64(photo), near) | (chosen[near] == photo)]
        weight[blend.vertex[part]] = blend.weight[part]
        total[near] += weight[mesh.faces[near]]
        weight[blend.vertex[part]] = 0.0
    return total


def _finish(plan: TexturePlan, canvases: Sequence[Canvas]) -> Model:
    """Round the pages, color triangles that no photo sees, and fill the space between charts."""
    drawn = plan.chosen != NONE
    pages, painted = (list(part) for part in zip(*(finish_page(page) for page in canvases), strict=True))
    corner_colors = np.zeros((len(drawn), 3, 3))
    for number, page in enumerate(pages):
        there = np.flatnonzero(drawn & (plan.page == number))
        at = np.floor(plan.corners[there]).astype(np.int64)
        corner_colors[there] = page[at[..., 1].clip(0, page.shape[0] - 1), at[..., 0].clip(0, page.shape[1] - 1)]
    colors = vertex_colors(plan.mesh, drawn, corner_colors[drawn])
    corners = plan.corners.copy()
    texels = square_texels(colors[plan.mesh.faces[~drawn]])
    number, x, y = plan.squares.T
    for dy in (0, 1):
        for dx in (0, 1):
            for k, page in enumerate(pages):
                here = number == k
                page[y[here] + dy, x[here] + dx] = texels[here, dy, dx]
                painted[k][y[here] + dy, x[here] + dx] = True
    corners[~drawn] = np.stack([x, y], axis=1)[:, None, :] + np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]])
    sizes = np.array(plan.layout.sizes, np.float64)
    uv = (corners / sizes[plan.page][:, None, :]).astype(np.float32)
    surface = Surface(plan.mesh.vertices, plan.mesh.faces, np.round(colors).astype(np.uint8))
    filled = tuple(fill_background(page, mask) for page, mask in zip(pages, painted, strict=True))
    return Model(surface, Texture(uv, plan.page, filled))


def _figures(
    plan: TexturePlan, views: Sequence[PhotoView], rejected: Sequence[Rejected | None], unseen: int
) -> dict[str, Any]:
    """Return the figures for the manifest."""
    covered = sum(width * height for width, height in plan.layout.sizes)
    return {
        "charts": len(plan.charts.photo),
        "pages": [list(size) for size in plan.layout.sizes],
        "texels": covered,
        "scale": round(plan.layout.scale, 3),
        "unseen_triangles": unseen,
        "strange_views_of_triangles": plan.seen.outliers,
        "gains": {
            view.name: [round(float(gain), 3) for gain in gains]
            for view, gains in zip(views, plan.seen.gains, strict=True)
        },
        "rejected": {view.name: found.reason for view, found in zip(views, rejected, strict=True) if found is not None},
    }
