"""Views of the dense workspace show the directions of their photos: of wide lenses, of plain ones, and larger."""

import cv2
import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.dense import read_views, undistort, used_pixels
from sfm_app.colmap.perspective import LargerViews
from sfm_app.colmap.wide_views import split_wide_photos, view_name, write_model, write_views
from sfm_app.photos.masks import save_mask
from sfm_app.progress import Progress
from sfm_app.stereo import rank_neighbors
from tests.unit.colored_photos import SIZE, colors_of, make_model, write_photos

NAMES = ("a.png", "sub/b.png", "c.png")


def rays_of(shape, K, R):
    """Rays (H, W, 3) of the pixel centers, in the world."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    return np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T @ R


def make_place(root, kind):
    """Three photos and their model."""
    model = make_model([kind], NAMES)
    write_photos(model, root / "photos")
    (root / "sparse").mkdir()
    model.write(root / "sparse")
    return model


def fill(root, masks=None, largest=1000):
    lenses = split_wide_photos(root / "sparse", largest)
    for name, camera_id in write_model(root / "sparse", lenses, root / "dense"):
        write_views(name, lenses[camera_id], root / "photos", masks, root / "dense")
    return lenses, read_views(root / "dense")


@pytest.mark.parametrize(
    ("kind", "count"), [("wide fisheye", 4), ("wide prism", 4), ("panorama", 6), ("strong barrel", 2)]
)
def test_views_show_the_directions_of_the_photo(tmp_path, kind, count):
    make_place(tmp_path, kind)
    _, views = fill(tmp_path)

    assert len(views) == 3 * count
    for view in views:
        rays = rays_of((view.height, view.width), view.K, view.R)
        used = used_pixels(tmp_path / "dense", view)
        used = np.ones(rays.shape[:2], bool) if used is None else used
        assert (kind == "panorama") == used.all() and 0.4 < used.mean() <= 1.0
        photo = cv2.imread(str(tmp_path / "dense" / "images" / view.name), cv2.IMREAD_COLOR_RGB)
        wrong = np.abs(photo.astype(int) - colors_of(rays))[used]
        assert np.mean(wrong) < 2.0 and np.quantile(wrong, 0.999) < 12


@pytest.mark.parametrize("kind", ["wide fisheye", "panorama"])
def test_points_are_seen_where_they_project(tmp_path, kind):
    model = make_place(tmp_path, kind)
    _, views = fill(tmp_path)

    found = pycolmap.Reconstruction(tmp_path / "dense" / "sparse")
    assert found.num_points3D() == model.num_points3D() and found.num_images() == len(views)
    # overlaps show some points twice
    assert model.compute_num_observations() <= found.compute_num_observations() < 1.6 * model.compute_num_observations()
    errors = [
        np.linalg.norm(image.project_point(found.points3D[point.point3D_id].xyz) - point.xy)
        for image in found.images.values()
        for point in image.points2D
    ]
    assert len(errors) == found.compute_num_observations() and max(errors) < 1e-6


def test_views_from_one_place_are_not_matched_with_each_other(tmp_path):
    make_place(tmp_path, "panorama")
    _, views = fill(tmp_path)
    for view, ranked in zip(views, rank_neighbors(views, 8), strict=True):
        photo = view.name.rsplit(".", 2)[0]
        assert all(views[other].name.rsplit(".", 2)[0] != photo for other in ranked)
    assert sum(map(len, rank_neighbors(views, 8))) > len(views)


def mask_left(root, columns):
    used = np.ones(SIZE[::-1], bool)
    used[:, :columns] = False
    for name in NAMES:
        save_mask(root / "masks", name, used)


def test_masked_pixels_are_masked_in_every_view(tmp_path):
    make_place(tmp_path, "wide fisheye")
    mask_left(tmp_path, SIZE[0] // 2)
    lenses, views = fill(tmp_path, tmp_path / "masks")

    for number, part in enumerate(lenses[1].views):
        view = next(view for view in views if view.name == view_name("a.png", number))
        at = lenses[1].locate(part.rays().reshape(-1, 3))
        left = (at[:, 0] < SIZE[0] / 2 - 1).reshape(view.height, view.width)
        used = used_pixels(tmp_path / "dense", view)
        assert not used[left].any()
        assert used[~left].mean() > 0.3 or left.mean() > 0.8


def test_ordinary_lenses_are_left_to_colmap(tmp_path):
    make_place(tmp_path, "wide fisheye")
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    camera = model.cameras[1]
    camera.model = pycolmap.CameraModelId.OPENCV
    camera.params = [250.0, 250.0, 120.0, 80.0, -0.1, 0.02, 0.0, 0.0]
    model.write(tmp_path / "sparse")
    assert split_wide_photos(tmp_path / "sparse", 1000) is None


def test_large_views_are_scaled_down_without_aliasing(tmp_path):
    make_place(tmp_path, "wide fisheye")
    lenses, views = fill(tmp_path, largest=120)
    assert max(max(view.width, view.height) for view in views) == 120
    assert all(view.K[0, 0] < 120.0 for view in views) and len(lenses[1].views) == 4


@pytest.fixture
def plain(tmp_path):
    """Photos of a lens that one view is enough for."""
    make_place(tmp_path, "plain")
    undistort(tmp_path / "sparse", tmp_path / "photos", tmp_path / "dense", 150, 1, Progress())
    return tmp_path, {view.name: view for view in read_views(tmp_path / "dense")}


def errors(photo):
    """How far gray levels of pixels without mask are from those of the directions."""
    expected = cv2.cvtColor(colors_of(rays_of(photo.gray.shape, photo.posed.K, photo.posed.R)), cv2.COLOR_RGB2GRAY)
    off = np.abs(photo.gray.astype(int) - expected)
    return off.ravel() if photo.masked is None else off[~photo.masked]


@pytest.mark.parametrize("side", [120, 2000])
def test_photos_of_a_plain_lens_keep_their_names(plain, side):
    place, views = plain
    found = LargerViews(place / "sparse", place / "photos", None, [views["c.png"], views["a.png"]], side)
    assert found.photos == ["a.png", "c.png"]
    for photo in found.photos:
        (larger,) = found.render(photo)
        longest = max(larger.gray.shape)
        assert larger.posed.name == photo and 0.9 * min(side, SIZE[0]) < longest <= side
        assert larger.gray.shape == (larger.posed.height, larger.posed.width)
        assert errors(larger).size > 0.98 * larger.gray.size and np.quantile(errors(larger), 0.999) < 6


def test_views_of_a_fisheye_are_those_of_the_workspace(tmp_path):
    make_place(tmp_path, "wide fisheye")
    _, views = fill(tmp_path)
    found = LargerViews(tmp_path / "sparse", tmp_path / "photos", None, views[1:], 120)
    rendered = {larger.posed.name: larger for photo in found.photos for larger in found.render(photo)}
    assert found.photos == sorted(NAMES) and sorted(rendered) == sorted(view.name for view in views[1:])
    for view in views[1:]:
        larger = rendered[view.name]
        np.testing.assert_array_equal(larger.posed.R, view.R)
        assert max(larger.gray.shape) <= 120 and np.quantile(errors(larger), 0.99) < 12


def test_masked_pixels_are_not_used(plain):
    place, views = plain
    mask_left(place, 100)
    larger = LargerViews(place / "sparse", place / "photos", place / "masks", [views["a.png"]], 240)
    (photo,) = larger.render("a.png")
    share = np.mean(~photo.masked, axis=0)
    assert photo.gray.shape == photo.masked.shape and share[:75].max() == 0.0 and share[-100:].min() > 0.9
