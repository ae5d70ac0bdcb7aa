"""A painted box whose photos are known to the pixel."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest
from painted_box import HALF, Album, around, assert_same_texture, box, on_surface, paint_at
from painted_box import textured as textured_surface

from sfm_app.texture import charts

pytestmark = pytest.mark.slow

VIEWS = around()
BOX = box()


def textured(album, surface=BOX, views=VIEWS, **options):
    return textured_surface(album, surface, views, **options)


def visible_part(model):
    """Triangles outside the box's bottom."""
    return model.surface.vertices[model.surface.faces][:, :, 1].max(axis=1) > -HALF[1] + 1e-6


def errors(model):
    points, colors = on_surface(model, among=visible_part(model))
    return np.abs(colors - paint_at(points)).max(axis=1)


@pytest.fixture(scope="module")
def plain():
    return textured(Album())


def test_every_point_has_its_color(plain):
    model, figures = plain
    wrong = errors(model)
    assert np.median(wrong) < 2.0
    assert np.quantile(wrong, 0.99) < 6.0
    assert 200 < figures["unseen_triangles"] < 400  # the bottom has 288; its neighbors may be seen too obliquely
    assert figures["strange_views_of_triangles"] == 0
    assert np.abs(np.array(list(figures["gains"].values())) - 1.0).max() < 0.01
    assert_vertices_have_their_color(model)


def assert_vertices_have_their_color(model):
    above = model.surface.vertices[:, 1] > -0.99 * HALF[1]
    wrong = np.abs(model.surface.colors[above] - paint_at(model.surface.vertices[above])).max(axis=1)
    assert np.quantile(wrong, 0.95) < 6.0


def test_charts_cover_a_good_part_of_the_pages(plain):
    model, figures = plain
    texture = model.texture
    assert figures["scale"] == 1.0
    assert len(texture.pages) == 1
    assert texture.uv.min() >= 0
    assert texture.uv.max() <= 1
    size = np.array(texture.pages[0].shape[1::-1])
    a, b, c = (texture.uv[:, k] * size for k in range(3))
    covered = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() / 2
    assert 0.3 < covered / size.prod() < 1.0


def test_a_darker_photo_leaves_no_seam():
    dark = VIEWS[2].name
    model, figures = textured(Album(exposure={dark: 0.7}))
    gains = figures["gains"]
    ratio = np.array(gains[dark]) / np.mean([gains[view.name] for view in VIEWS if view.name != dark], axis=0)
    np.testing.assert_allclose(ratio, 0.7, atol=0.01)
    points, colors = on_surface(model, among=visible_part(model))
    factor = np.median(colors / paint_at(points))  # the common exposure is free
    assert np.quantile(np.abs(colors / factor - paint_at(points)).max(axis=1), 0.99) < 7.0


CROSSING = (slice(70, 150), slice(120, 170))
PASSER_BY = {VIEWS[4].name: CROSSING}


def test_a_passer_by_is_absent():
    model, figures = textured(Album(passers_by=PASSER_BY))
    assert figures["strange_views_of_triangles"] > 30
    wrong = errors(model)
    assert np.quantile(wrong, 0.99) < 8.0
    assert wrong.max() < 60.0  # magenta is some 120 away


def masked_crossing(view):
    """All pixels but the passer-by and a line across the photo, thinner than a triangle."""
    used = np.ones((view.height, view.width), bool)
    used[CROSSING] = used[100, :] = False
    return used


def test_triangles_with_masked_pixels_are_not_painted():
    view = VIEWS[4]
    used = masked_crossing(view)
    near = cv2.erode(used.view(np.uint8), np.ones((7, 7), np.uint8)) > 0

    whole = textured(Album(), views=[view], unseen_faces="cut")[0].surface
    kept = textured(Album(masks={view.name: used}), views=[view], unseen_faces="cut")[0].surface

    parts = np.random.default_rng(0).dirichlet([1.0] * 3, 300)
    shown = [_pixels(view, np.einsum("nk,tkc->tnc", parts, part.vertices[part.faces])) for part in (whole, kept)]
    in_whole, in_kept = (np.floor(at).astype(int) for at in shown)
    assert used[in_kept[..., 1], in_kept[..., 0]].all()
    clear = near[in_whole[..., 1], in_whole[..., 0]].all(axis=1)
    assert 0.5 * len(clear) < clear.sum() <= len(kept.faces) < 0.9 * len(clear)


def test_masked_pixels_do_not_change_a_byte():
    """Two photos alone do not show which of them is right where they disagree; a mask does."""
    pair, masks = VIEWS[4:6], {VIEWS[4].name: masked_crossing(VIEWS[4])}

    without, alone = textured(Album(passers_by=PASSER_BY), views=pair)
    model, figures = textured(Album(passers_by=PASSER_BY, masks=masks), views=pair)
    expected, same = textured(Album(masks=masks), views=pair)

    assert alone["strange_views_of_triangles"] == 0
    assert figures == same
    assert_same_texture(model, expected)
    assert not np.array_equal(without.texture.pages[0], expected.texture.pages[0])


def test_unseen_triangles_have_the_colors_around_them(plain):
    model, _ = plain
    _, colors = on_surface(model, among=~visible_part(model))
    rim = model.surface.colors[np.isclose(model.surface.vertices[:, 1], -HALF[1])]
    assert colors.min() > rim.min() - 3
    assert colors.max() < rim.max() + 3
    assert colors.std(axis=0).min() > 3.0  # not one flat color


def test_unseen_triangles_can_be_cut(plain):
    model, figures = textured(Album(), unseen_faces="cut")
    assert len(model.surface.faces) == len(BOX.faces) - figures["unseen_triangles"]
    assert len(model.texture.uv) == len(model.texture.page) == len(model.surface.faces)
    assert np.unique(model.surface.faces).tolist() == list(range(len(model.surface.vertices)))
    assert visible_part(model).all()
    assert np.quantile(errors(model), 0.99) < 6.0


def test_small_pages_make_everything_smaller():
    model, figures = textured(Album(), max_atlas_px=256, max_pages=1)
    assert all(max(page.shape[:2]) <= 256 for page in model.texture.pages)
    assert len(model.texture.pages) == 1
    assert 0.2 < figures["scale"] < 1.0
    assert np.quantile(errors(model), 0.99) < 10.0


def test_threads_do_not_change_a_byte(plain):
    def last_first(function, items, label):
        with ThreadPoolExecutor(3) as executor:
            waiting = [executor.submit(function, item) for item in reversed(items)]
            return [future.result() for future in reversed(waiting)]

    model, figures = textured(Album(), spread=last_first)
    assert figures == plain[1]
    assert_same_texture(model, plain[0])


def test_a_missing_photo_is_counted():
    missing = VIEWS[0].name
    model, figures = textured(Album(lost=(missing,)))
    assert figures["rejected"] == {missing: "cannot be read: No such file or directory"}
    assert np.quantile(errors(model), 0.99) < 8.0


def test_without_any_photo_the_previous_colors_stay():
    lost = tuple(view.name for view in VIEWS)
    model, figures = textured(Album(lost=lost))
    assert figures["unseen_triangles"] == len(BOX.faces)
    _, colors = on_surface(model)
    np.testing.assert_allclose(colors, 77.0, atol=0.5)


def test_an_occluder_leaves_no_print():
    """A board between one camera and the box: the box must not show the board's color."""
    board_at = VIEWS[4].center * 0.6
    side = np.cross(board_at, [0.0, 1.0, 0.0])
    side *= 0.25 / np.linalg.norm(side)
    up = np.array([0.0, 0.25, 0.0])
    corners = np.array([board_at - side - up, board_at + side - up, board_at + side + up, board_at - side + up])
    faces = np.concatenate([BOX.faces, len(BOX.vertices) + np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])])
    surface = replace(
        BOX, vertices=np.concatenate([BOX.vertices, corners]), faces=faces,
        colors=np.concatenate([BOX.colors, np.zeros((4, 3), np.uint8)]),
    )  # fmt: skip
    x, y = _pixels(VIEWS[4], corners).T
    rectangle = (slice(int(y.min()), int(y.max()) + 1), slice(int(x.min()), int(x.max()) + 1))
    model, _ = textured(Album(passers_by={VIEWS[4].name: rectangle}), surface=surface, views=VIEWS[3:6])
    among = np.concatenate([visible_part(replace(model, surface=BOX)), np.zeros(4, bool)])
    points, colors = on_surface(model, among=among & (surface.vertices[faces].mean(axis=1) @ VIEWS[4].center > 0.5))
    assert np.quantile(np.abs(colors - paint_at(points)).max(axis=1), 0.97) < 12.0


def _pixels(view, points):
    local = points @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
    plane = local[..., :2] / local[..., 2:]
    return plane * np.array(view.lens[:2]) + np.array(view.lens[2:4])


def test_blocks_have_the_same_colors_and_are_painted_once(plain, monkeypatch):
    monkeypatch.setattr(charts, "OPTIONS", replace(charts.OPTIONS, block_triangles=600))
    album = Album()
    model, figures = textured(album)

    assert len(model.texture.pages) == len(figures["pages"]) == 3
    assert figures["strange_views_of_triangles"] == plain[1]["strange_views_of_triangles"]
    assert np.quantile(errors(model), 0.99) < 6.0
    assert_vertices_have_their_color(model)
    assert {"block0", "block1", "block2"} <= set(album.kept)
    album.read.clear()

    again, _ = textured(album)

    assert album.read == []
    assert_same_texture(again, model)
