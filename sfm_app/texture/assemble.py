"""From a surface and photos to a textured surface: the steps of texturing in order."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import select_faces, split_fans
from sfm_app.settings import TextureSettings
from sfm_app.tasks import ParallelMap
from sfm_app.texture.appearance import outlier_mask, photo_gains
from sfm_app.texture.charts import (
    SQUARE_CORNERS,
    Charts,
    Layout,
    absorb_small_charts,
    block_of_faces,
    lay_out,
    make_charts,
    square_texels,
    vertex_colors,
)
from sfm_app.texture.pages import CheckedViews, Store, TexturePlan, fill_background, paint_blocks
from sfm_app.texture.seams import Blend, blend_weights, level_seams
from sfm_app.texture.sightings import (
    NONE,
    Facets,
    FaceView,
    IntArray,
    facets,
    list_sightings,
    score_faces,
    sharpness_factors,
)
from sfm_app.texture.view_selection import choose_photos
from sfm_app.texture.views import PhotoView
from sfm_app.types import Model, Rejected, Surface, Texture
from sfm_app.types.arrays import BoolArray, IndexArray


def texture_surface(
    surface: Surface, views: Sequence[PhotoView], store: Store, options: TextureSettings, spread: ParallelMap
) -> tuple[Model, dict[str, Any]]:
    """Paint a surface, in the frame of the views, with photos.

    The store keeps the results of each photo, so that a killed run can continue. Returns the surface with texture and
    colors from the photos, cut if the options say so, and figures for the manifest.
    """
    mesh = facets(surface)

    face_views = spread(partial(_score_photo, views, store, mesh), range(len(views)), "finding visible triangles")
    checked = _check_views(face_views, mesh)
    chosen = absorb_small_charts(choose_photos(checked.sightings, mesh), checked.sightings, mesh.neighbors)
    unseen = chosen == NONE
    if options.unseen_faces == "cut" and not unseen.all():
        mesh, checked = _cut_faces(unseen, mesh, checked)
        chosen = chosen[~unseen]
    plan = _plan(mesh, checked, chosen, views, options, spread)
    rejected = [view if isinstance(view, Rejected) else None for view in face_views]
    painted = paint_blocks(plan, views, store, spread, [reason is None for reason in rejected])
    return _finish(plan, painted), {
        "triangles": len(plan.mesh.faces),
        "charts": len(plan.charts.photo),
        "pages": [list(size) for size in plan.layout.sizes],
        "texels": sum(width * height for width, height in plan.layout.sizes),
        "scale": round(plan.layout.scale, 3),
        "unseen_triangles": int(unseen.sum()),
        "strange_views_of_triangles": plan.checked.outliers,
        "gains": {
            view.name: [round(float(gain), 3) for gain in gains]
            for view, gains in zip(views, plan.checked.gains, strict=True)
        },
        "rejected": {view.name: one.reason for view, one in zip(views, rejected, strict=True) if one is not None},
    }


def _score_photo(views: Sequence[PhotoView], store: Store, mesh: Facets, photo: int) -> FaceView | Rejected:
    name, view = f"view{photo}", views[photo]
    kept = store.recall(name)
    if kept is not None and "face" in kept:
        return FaceView(kept["face"], kept["score"], kept["color"], float(kept["sharpness"]))
    try:
        picture, used = store.photo(view), store.usable_pixels(view)
    except OSError as err:
        return Rejected(f"cannot be read: {err.strerror or 'damaged'}")
    face_view = score_faces(view, picture, used, mesh)
    face, sharpness = face_view.face, np.array(face_view.sharpness)
    store.keep(name, {"face": face, "score": face_view.score, "color": face_view.color, "sharpness": sharpness})
    return face_view


def _check_views(face_views: Sequence[FaceView | Rejected], mesh: Facets) -> CheckedViews:
    """Adjust the scores by sharpness, estimate gains, and mark outliers by negative scores."""
    sharpness = np.array([0.0 if isinstance(view, Rejected) else view.sharpness for view in face_views])
    sharp = sharpness > 0
    factor = np.zeros(len(sharp))
    factor[sharp] = sharpness_factors(sharpness[sharp])
    usable = [
        None if isinstance(view, Rejected) or not use else view for view, use in zip(face_views, sharp, strict=True)
    ]
    sightings = list_sightings(usable, len(mesh.faces))
    sightings = replace(sightings, score=sightings.score * factor[sightings.photo].astype(np.float32))
    gains = photo_gains(sightings)
    outlier = outlier_mask(sightings, gains, mesh.neighbors)
    score = np.where(outlier, -sightings.score, sightings.score)
    return CheckedViews(replace(sightings, score=score), gains, int(outlier.sum()))


def _cut_faces(cut: BoolArray, mesh: Facets, checked: CheckedViews) -> tuple[Facets, CheckedViews]:
    """Cut triangles (T,) from the surface and its views, but not all."""
    if cut.all() or not cut.any():
        return mesh, checked
    rest = facets(split_fans(select_faces(mesh.surface, ~cut)))
    return rest, replace(checked, sightings=checked.sightings.select_triangles(~cut))


def _plan(
    mesh: Facets, checked: CheckedViews, chosen: IntArray, views: Sequence[PhotoView], options: TextureSettings,
    spread: ParallelMap,
) -> TexturePlan:  # fmt: skip
    block_of = block_of_faces(mesh)

    def lay_out_charts() -> tuple[Charts, tuple[Layout, IndexArray, IntArray]]:
        charts = make_charts(chosen, np.array([view.row for view in views]), mesh, options.max_atlas_px / 2, block_of)
        return charts, lay_out(charts, block_of, mesh, options)

    def blend_photos() -> Blend:
        return level_seams(blend_weights(chosen, checked.sightings, mesh), checked.sightings, checked.gains, mesh)

    (charts, (layout, cells, block_of_page)), blend = spread(
        lambda job: job(), (lay_out_charts, blend_photos), "planning the texture"
    )
    corners, page = charts.corners * layout.scale, np.zeros(len(chosen), np.int32)
    drawn = chosen != NONE
    corners[drawn] += layout.shift[charts.chart_of_face[drawn]][:, None, :]
    page[drawn] = layout.page[charts.chart_of_face[drawn]]
    page[~drawn] = cells[:, 0]
    allowed, weight = np.zeros(mesh.faces.shape, np.float32), np.zeros(len(mesh.vertices), np.float32)
    for photo in range(checked.sightings.photos):
        part = blend.photo_rows(photo)
        near = mesh.faces_at(blend.vertex[part])
        near = near[checked.sightings.is_usable(photo, near) | (chosen[near] == photo)]
        weight[blend.vertex[part]] = blend.weight[part]
        allowed[near] += weight[mesh.faces[near]]
        weight[blend.vertex[part]] = 0.0
    return TexturePlan(mesh, checked, chosen, charts, layout, corners, page, block_of_page, cells, blend, allowed)


def _finish(plan: TexturePlan, finished: Sequence[tuple[NDArray[np.uint8], BoolArray]]) -> Model:
    """Color triangles without a photo, and fill the space between charts."""
    drawn = plan.chosen != NONE
    pages, painted = (list(part) for part in zip(*finished, strict=True))
    corner_colors = np.zeros((len(drawn), 3, 3))
    for number, page in enumerate(pages):
        own = np.flatnonzero(drawn & (plan.page == number))
        at = np.floor(plan.corners[own]).astype(np.int64)
        corner_colors[own] = page[at[..., 1].clip(0, page.shape[0] - 1), at[..., 0].clip(0, page.shape[1] - 1)]
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
