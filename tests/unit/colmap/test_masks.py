"""Masks where COLMAP is at work: no keypoint, no depth and no fused point comes from what is masked."""

import cv2
import numpy as np
import pytest
from PIL import Image

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import create_database, read_match_graph
from sfm_app.colmap.dense import (
    MASKED,
    REACH_PX,
    DenseStore,
    MaskUndistorter,
    mask_depths,
    read_depth,
    read_views,
    undistort,
    used_pixels,
    write_fusion_views,
    write_maps,
)
from sfm_app.colmap.features import find_and_match
from sfm_app.colmap.surface import FUSED, fuse, open_points, positions
from sfm_app.photos.masks import save_mask
from sfm_app.progress import SilentProgress
from sfm_app.settings import MatchSettings
from sfm_app.stereo import DepthEstimate, DepthMap
from sfm_app.types import Photo, PhotoSet

SIZE = 240, 160
NAMES = ("1.png", "sub/2.png", "3.png")


def blots(seed):
    coarse = np.random.default_rng(seed).integers(0, 255, (SIZE[1] // 8, SIZE[0] // 8, 3), np.uint8)
    return Image.fromarray(coarse).resize(SIZE, Image.Resampling.BICUBIC)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Three photos of a barrel lens and their masks: the left half, a thin cross, and none."""
    root = tmp_path_factory.mktemp("masks")
    used = {name: np.ones(SIZE[::-1], bool) for name in NAMES}
    used["1.png"][:, :120] = False
    used["sub/2.png"][80] = used["sub/2.png"][:, 60] = False
    for seed, name in enumerate(NAMES):
        (root / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        blots(seed).save(root / "photos" / name)
        save_mask(root / "masks", name, used[name])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="OPENCV", width=240, height=160, params=[200, 205, 118, 83, -0.2, 0, 0, 0])
    )
    for index, name in enumerate(NAMES, start=1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), np.array([-0.1 * index, 0, 0]))
        model.add_image_with_trivial_frame(pycolmap.Image(image_id=index, name=name, camera_id=1), pose)
    (root / "sparse").mkdir()
    model.write(root / "sparse")
    return root, used


@pytest.fixture
def dense(place, tmp_path):
    root, _ = place
    undistort(root / "sparse", root / "photos", tmp_path, 120, 1, SilentProgress())
    views = read_views(tmp_path)
    for view in views:
        MaskUndistorter(root / "sparse", root / "masks", tmp_path)(view)
    return tmp_path, {view.name: view for view in views}


@pytest.mark.slow
def test_no_keypoint_lies_in_what_is_masked(place, tmp_path):
    """The photos are in the database before features are looked for, as in every run."""
    root, used = place
    photos = PhotoSet(root / "photos", tuple(Photo(name, *SIZE, "g") for name in NAMES))
    found = {}
    for masks in (None, root / "masks"):
        database = tmp_path / f"{masks is None}.db"
        create_database(database, photos)
        find_and_match(database, root / "photos", NAMES, MatchSettings(), 1, SilentProgress(), masks)
        graph = read_match_graph(database, photos)
        found[masks] = {graph.images[key].name: np.floor(at).astype(int) for key, at in graph.keypoints.items()}

    for name in NAMES:
        whole, kept = (used[name][at[:, 1], at[:, 0]] for at in (found[None][name], found[root / "masks"][name]))
        assert kept.all()
        assert len(kept) == np.count_nonzero(whole) > 20
    assert len(found[None]["1.png"]) > 1.5 * len(found[root / "masks"]["1.png"])


def test_masks_are_undistorted_as_photos_are(place, dense):
    root, used = place
    model = pycolmap.Reconstruction(root / "sparse")
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = 120
    square = np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8)
    for name, view in dense[1].items():
        bitmap = pycolmap.Bitmap.from_array(np.where(used[name], np.uint8(255), np.uint8(0)))
        theirs = pycolmap.undistort_image(options, bitmap, model.cameras[1])[0].to_array()
        seen = used_pixels(dense[0], view)

        assert seen.shape == theirs.shape == (view.height, view.width)
        near = cv2.erode(theirs, square)
        assert (near[seen] == 255).all()  # nothing masked shows through, and next to nothing is lost
        wide = cv2.erode(theirs, np.ones((2 * REACH_PX + 5, 2 * REACH_PX + 5), np.uint8))
        assert seen[wide == 255].all()
    assert used_pixels(dense[0], dense[1]["3.png"]).all()


def test_without_masks_all_is_used(place, tmp_path):
    root, _ = place
    undistort(root / "sparse", root / "photos", tmp_path, 120, 1, SilentProgress())
    view = read_views(tmp_path)[0]
    depth = np.full((view.height, view.width), 3.0, np.float32)

    assert used_pixels(tmp_path, view) is None
    DenseStore(tmp_path).write_estimate(view, DepthEstimate(depth, depth / 4))
    write_maps(tmp_path, view, DepthMap(depth, np.zeros((*depth.shape, 3), np.float32)))
    mask_depths(tmp_path, view)

    assert (DenseStore(tmp_path).read_estimate(view).depth == 3).all()
    assert (read_depth(tmp_path, view, "geometric") == 3).all()


def test_estimates_have_no_depth_where_the_photo_is_masked(dense):
    """And no doubt: else what is masked counts as one plain area with a wall beside it."""
    folder, views = dense
    view = views["sub/2.png"]
    used, depth = used_pixels(folder, view), np.full((view.height, view.width), 3.0, np.float32)

    DenseStore(folder).write_estimate(view, DepthEstimate(depth, np.full_like(depth, 0.05)))
    found = DenseStore(folder).read_estimate(view)

    np.testing.assert_array_equal(found.depth, np.where(used, 3, 0))
    np.testing.assert_allclose(found.confidence, np.where(used, 0.05, 1))
    small = view.halve(1)
    DenseStore(folder).write_estimate(small, DepthEstimate(depth[::2, ::2], np.full_like(depth[::2, ::2], 0.05)))
    all_used = used[: small.height * 2, : small.width * 2].reshape(small.height, 2, small.width, 2).all(axis=(1, 3))
    found = DenseStore(folder).read_estimate(small)
    np.testing.assert_array_equal(found.depth, np.where(all_used, 3, 0))


def test_nothing_is_fused_from_what_is_masked(dense):
    folder, views = dense
    normals = np.zeros((*used_pixels(folder, views["1.png"]).shape, 3), np.float32)
    normals[..., 2] = -1
    for view in views.values():
        write_maps(folder, view, DepthMap(np.full(normals.shape[:2], 4.0, np.float32), normals))
        mask_depths(folder, view)
        mask_depths(folder, view)  # a killed run does it twice
    view = views["1.png"]
    used = used_pixels(folder, view)
    np.testing.assert_array_equal(read_depth(folder, view, "geometric"), np.where(used, 4, np.float32(MASKED)))

    write_fusion_views(folder, [view])
    fuse(folder, 1, np.array([[-50.0] * 3, [50.0] * 3]), folder / FUSED)
    points = positions(open_points(folder / FUSED))

    at = (points @ view.R.T + view.t) @ view.K.T
    col, row = np.rint(at[:, :2] / at[:, 2:]).astype(int).T
    assert len(points) == np.count_nonzero(used)
    assert used[row, col].all()
