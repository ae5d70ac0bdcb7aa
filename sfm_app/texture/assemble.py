"""From a surface and photos to a textured surface: the steps of texturing in order."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import select_faces, split_fans
from sfm_app.settings import TextureSettings
from sfm_app.texture.appearance import doubtful_border, outlier_mask, photo_gains
from sfm_app.texture.charts import Charts, Layout, absorb_small_charts, block_of_faces, lay_out, make_charts
from sfm_app.texture.facets import NONE, Facets, IntArray, facets
from sfm_app.texture.pages import CheckedViews, ParallelMap, Store, TexturePlan, fill_background, paint_blocks
from sfm_app.texture.seams import SQUARE_CORNERS, Blend, blend_weights, level_seams, square_texels, vertex_colors
from sfm_app.texture.sightings import FaceView, OcclusionTest, Sightings, list_sightings, score_faces, sharpness_factors
from sfm_app.texture.view_selection import choose_photos
from sfm_app.texture.views import PhotoView
from sfm_app.types import Model, Rejected, Surface, Texture
from sfm_app.types.arrays import IndexArray


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
    seen, trimmed = _check_views(looks, mesh), 0
    if options.trim_borders:
        border = doubtful_border(seen.all, seen.gains, mesh.neighbors)
        mesh, seen, trimmed = *_cut_faces(border, mesh, seen), int(border.sum())
    chosen = absorb_small_charts(choose_photos(seen.all, mesh), seen.all, mesh.neighbors)
    unseen = chosen == NONE
    if options.unseen_faces == "cut" and not unseen.all():
        mesh, seen = _cut_faces(unseen, mesh, seen)
        chosen = chosen[~unseen]
    plan = _plan(mesh, seen, chosen, (views, options), spread)
    rejected = [look if isinstance(look, Rejected) else None for look in looks]
    painted = paint_blocks(plan, views, store, spread, [reason is None for reason in rejected])
    return _finish(plan, painted), _figures(plan, views, rejected, (int(unseen.sum()), trimmed))


def _score_photos(
    views: Sequence[PhotoView], mesh: Facets, store: Store, hidden: OcclusionTest, spread: ParallelMap
) -> list[FaceView | Rejected]:
    def score(photo: int) -> FaceView | Rejected:
        return _score_photo(f"look{photo}", views[photo], mesh, store, hidden)

    return spread(score, range(len(views)), "looking at the surface")


def _score_photo(name: str, view: PhotoView, mesh: Facets, store: Store, hidden: OcclusionTest) -> FaceView | Rejected:
    kept = store.recall(name)
    if kept is not None and "face" in kept:
        return FaceView(kept["face"], kept["worth"], kept["color"], float(kept["sharpness"]))
    try:
        photo, used = store.photo(view), store.usable_pixels(view)
    except OSError as err:
        return Rejected(f"cannot be read: {err.strerror or 'damaged'}")
    found = score_faces(view, photo, used, mesh, hidden)
    sharp = np.array(found.sharpness)
    store.keep(name, {"face": found.face, "worth": found.worth, "color": found.color, "sharpness": sharp})
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


def _cut_faces(gone: NDArray[np.bool_], mesh: Facets, seen: CheckedViews) -> tuple[Facets, CheckedViews]:
    """Return the surface and its views without some triangles (T,), if others are left."""
    if gone.all() or not gone.any():
        return mesh, seen
    kept = facets(split_fans(select_faces(mesh.surface, ~gone)))
    return kept, replace(seen, all=seen.all.select_triangles(~gone))


def _plan(
    mesh: Facets, seen: CheckedViews, chosen: IntArray, given: tuple[Sequence[PhotoView], TextureSettings],
    spread: ParallelMap,
) -> TexturePlan:  # fmt: skip
    views, options = given
    block_of = block_of_faces(mesh)

    def place() -> tuple[Charts, tuple[Layout, IndexArray, IntArray]]:
        charts = make_charts(chosen, np.array([view.row for view in views]), mesh, options.max_atlas_px / 2, block_of)
        return charts, lay_out(charts, block_of, mesh, options)

    def mix() -> Blend:
        return level_seams(blend_weights(chosen, seen.all, mesh), seen.all, seen.gains, mesh)

    (charts, (layout, cells, block_of_page)), blend = spread(lambda job: job(), (place, mix), "planning the texture")
    corners, page = charts.corners * layout.scale, np.zeros(len(chosen), np.int32)
    drawn = chosen != NONE
    corners[drawn] += layout.shift[charts.chart_of_face[drawn]][:, None, :]
    page[drawn] = layout.page[charts.chart_of_face[drawn]]
    page[~drawn] = cells[:, 0]
    allowed = _allowed_weight(blend, seen.all, chosen, mesh)
    return TexturePlan(mesh, seen, chosen, charts, layout, corners, page, block_of_page, cells, blend, allowed)


def _allowed_weight(blend: Blend, seen: Sightings, chosen: IntArray, mesh: Facets) -> NDArray[np.float32]:
    total = np.zeros(mesh.faces.shape, np.float32)
    weight = np.zeros(len(mesh.vertices), np.float32)
    for photo in range(seen.photos):
        part = blend.photo_rows(photo)
        near = mesh.faces_at(blend.vertex[part])
        near = near[seen.is_usable(photo, near) | (chosen[near] == photo)]
        weight[blend.vertex[part]] = blend.weight[part]
        total[near] += weight[mesh.faces[near]]
        weight[blend.vertex[part]] = 0.0
    return total


def _finish(plan: TexturePlan, finished: Sequence[tuple[NDArray[np.uint8], NDArray[np.bool_]]]) -> Model:
    """Round the pages, color triangles that no photo sees, and fill the space between charts."""
    drawn = plan.chosen != NONE
    pages, painted = (list(part) for part in zip(*finished, strict=True))
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
    corners[~drawn] = np.stack([x, y], axis=1)[:, None, :] + SQUARE_CORNERS
    sizes = np.array(plan.layout.sizes, np.float64)
    uv = (corners / sizes[plan.page][:, None, :]).astype(np.float32)
    surface = Surface(plan.mesh.vertices, plan.mesh.faces, np.round(colors).astype(np.uint8))
    filled = tuple(fill_background(page, mask) for page, mask in zip(pages, painted, strict=True))
    return Model(surface, Texture(uv, plan.page, filled))


def _figures(
    plan: TexturePlan, views: Sequence[PhotoView], rejected: Sequence[Rejected | None], counts: tuple[int, int]
) -> dict[str, Any]:
    """Return the figures for the manifest; the counts are those of unseen triangles and of trimmed ones."""
    covered = sum(width * height for width, height in plan.layout.sizes)
    return {
        "triangles": len(plan.mesh.faces),
        "charts": len(plan.charts.photo),
        "pages": [list(size) for size in plan.layout.sizes],
        "texels": covered,
        "scale": round(plan.layout.scale, 3),
        "unseen_triangles": counts[0],
        "trimmed_triangles": counts[1],
        "strange_views_of_triangles": plan.seen.outliers,
        "gains": {
            view.name: [round(float(gain), 3) for gain in gains]
            for view, gains in zip(views, plan.seen.gains, strict=True)
        },
        "rejected": {view.name: found.reason for view, found in zip(views, rejected, strict=True) if found is not None},
    }
