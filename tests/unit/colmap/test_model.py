"""COLMAP's model: built, moved and read as arrays."""

import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap, translate_errors
from sfm_app.colmap.bundle import adjust
from sfm_app.colmap.model import (
    cameras_by_photo,
    focal_px,
    model_arrays,
    move,
    placed_views,
    posed_photo_ids,
    poses_and_points,
    sparse_model,
    submodel,
    viewing_rays,
)
from sfm_app.errors import BackendError, ConfigError
from sfm_app.geometry.poses import Similarity


def test_a_model_moves_as_a_whole(synthetic):
    model, _ = synthetic()
    error = model.compute_mean_reprojection_error()
    poses, points = poses_and_points(model)
    similarity = Similarity(7.0, np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), np.array([30.0, -5, 2]))

    move(model, similarity)
    moved_poses, moved_points = poses_and_points(model)

    assert list(moved_poses) == list(poses) == sorted(model.images)
    assert np.allclose(moved_points, similarity(points))
    for key, pose in poses.items():
        assert np.allclose(moved_poses[key][:, :3], pose[:, :3] @ similarity.R.T)
    assert model.compute_mean_reprojection_error() == pytest.approx(error, rel=1e-4)


def test_rays_of_a_lens_meet_the_points_that_the_photo_shows(synthetic):
    model, _ = synthetic([900.0, 900.0, 530.0, 380.0, -0.08, 0.0, 0.0, 0.0])
    poses, _ = poses_and_points(model)
    key = min(poses)
    seen = [point for point in model.images[key].points2D if point.has_point3D()]
    center = -poses[key][:, :3].T @ poses[key][:, 3]
    truth = np.array([model.points3D[point.point3D_id].xyz for point in seen]) - center
    rays = viewing_rays(model, key, np.array([point.xy for point in seen]))
    sine = np.linalg.norm(np.cross(rays, truth), axis=1) / np.linalg.norm(rays, axis=1) / np.linalg.norm(truth, axis=1)
    assert 0.1 < np.sqrt(np.mean((sine * focal_px(model, key)) ** 2)) < 0.8, "the noise of 0.3 px"
    assert ((rays * truth).sum(axis=1) > 0).all()


def test_placed_views_see_the_points_where_they_are(synthetic):
    """Through a lens, with two focals: the rays of keypoints meet the model's points."""
    model, _ = synthetic([900.0, 850.0, 510.0, 390.0, -0.1, 0.0, 0.0, 0.0], noise_px=0.0, photos=4)
    model.deregister_frame(model.images[4].frame_id)
    keypoints = {key: np.array([p.xy for p in image.points2D]) for key, image in model.images.items()}

    views = placed_views(model, keypoints)

    assert sorted(views) == [1, 2, 3]
    for key, view in views.items():
        seen = [(k, p.point3D_id) for k, p in enumerate(model.images[key].points2D) if p.has_point3D()]
        X = np.array([model.points3D[number].xyz for _, number in seen]) @ view.R.T + view.t
        lines = view.lines[[k for k, _ in seen]]
        np.testing.assert_allclose(lines[:, :3], X / X[:, 2:], atol=1e-5)
        np.testing.assert_allclose(1.0 / lines[:, [3, 7]], [[900.0, 850.0]] * len(lines))


@pytest.mark.parametrize(
    ("name", "params", "focals"),
    [("SIMPLE_RADIAL", [880.0, 510.0, 390.0, -0.1], (880, 880)),
     ("OPENCV", [900.0, 850.0, 510.0, 390.0, -0.1, 0.02, 0.0, 0.0], (900, 850))],
)  # fmt: skip
def test_cameras_are_read_with_their_first_radial_term(synthetic, name, params, focals):
    model, _ = synthetic(photos=3)
    model.deregister_frame(model.images[2].frame_id)
    for camera in model.cameras.values():
        camera.model = getattr(pycolmap.CameraModelId, name)
        camera.params = params
    found = cameras_by_photo(model)
    assert sorted(found) == [1, 3]
    for K, (radial,) in found.values():
        assert (K[0, 0], K[1, 1], K[0, 2], K[1, 2], radial) == (*focals, 510.0, 390.0, -0.1)


def test_a_part_of_a_model_can_be_adjusted_and_the_whole_stays(synthetic):
    model, database = synthetic(photos=6)
    part = submodel(model, (1, 3, 4))
    adjusted = adjust(part, database)
    found = adjusted.model
    assert posed_photo_ids(found) == sorted(found.images) == [1, 3, 4] and posed_photo_ids(model) == [1, 2, 3, 4, 5, 6]
    assert all(point.track.length() >= 2 for point in found.points3D.values()) and found.num_points3D() > 350
    assert all(0 < one["deviations"]["fx"] < 20 for one in adjusted.refined.values())


def test_what_colmap_raises_becomes_one_of_ours():
    with (
        pytest.raises(BackendError, match=r"COLMAP failed while reading: .*cannot find it") as caught,
        translate_errors("reading"),
    ):
        raise ValueError("[reconstruction.cc:1] cannot find it\n")
    assert isinstance(caught.value.__cause__, ValueError)
    with pytest.raises(ConfigError), translate_errors("reading"):
        raise ConfigError("ours stays ours")


def test_points_and_cameras_of_a_model_on_disk(synthetic, tmp_path):
    model, _ = synthetic([900.0, 850.0, 510.0, 390.0, -0.1, 0.0, 0.0, 0.0], noise_px=0.0)
    model.deregister_frame(model.images[4].frame_id)
    model.write(tmp_path)

    found = sparse_model(tmp_path)

    poses, points = poses_and_points(model)
    np.testing.assert_array_equal(found.surface.vertices, points)
    assert len(found.surface.colors) == len(points) and found.surface.faces.shape == (0, 3)
    assert [camera.name for camera in found.cameras] == [model.images[key].name for key in poses]
    for camera, pose in zip(found.cameras, poses.values(), strict=True):
        np.testing.assert_allclose(camera.cam_from_world, pose)
        np.testing.assert_allclose(camera.K, [[900, 0, 510], [0, 850, 390], [0, 0, 1]])


def test_points_of_two_photos_count_where_three_photos_see_the_scene(synthetic, tmp_path):
    model, _ = synthetic(noise_px=0.0)
    _, points = poses_and_points(model)
    before = len(points)
    for place in (points.mean(axis=0), points.max(axis=0) + 1.0, points.mean(axis=0) - [0, 0, 1e3]):
        track = pycolmap.Track()
        for image in (1, 2):
            points2D = model.images[image].points2D
            track.add_element(image, next(i for i, one in enumerate(points2D) if not one.has_point3D()))
        model.add_point3D(place, track, np.zeros(3, np.uint8))
    model.write(tmp_path)

    found = sparse_model(tmp_path)

    assert len(found.surface.vertices) == before + 1


def test_points_fall_on_the_pixels_of_their_tracks_and_photos_look_from_their_centers(synthetic):
    model, _ = synthetic(noise_px=0.0)
    found = model_arrays(model, metric=True)

    assert found.photos == tuple(sorted(image.name for image in model.images.values()))
    assert len(found.points) == len(found.colors) == len(found.errors_px) == model.num_points3D()
    assert len(found.track_pixels) == len(found.track_photos) == model.compute_num_observations()
    assert (np.diff(found.track_points) >= 0).all()
    R, t = (found.cam_from_world[found.track_photos][..., part] for part in (slice(3), 3))
    seen = np.einsum("mij,mj->mi", R, found.points[found.track_points]) + t
    x = np.einsum("mij,mj->mi", found.K[found.track_photos], seen)
    assert np.allclose(x[:, :2] / x[:, 2:], found.track_pixels, atol=1e-6)
    true = {image.name: image.projection_center() for image in model.images.values()}
    assert np.allclose(found.centers, [true[name] for name in found.photos])
    assert found.sizes.tolist() == [[1000, 800]] * 8 and found.metric
