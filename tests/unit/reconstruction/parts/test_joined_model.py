"""COLMAP's models as arrays and back, and the adjustment of what was joined."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.joined_model import read_placed, adjust_joined, write_placed
from sfm_app.colmap.model import poses_and_points
from sfm_app.geometry.poses import umeyama

pytestmark = pytest.mark.slow


@pytest.fixture
def placed(synthetic, tmp_path):
    synthetic.model.write(tmp_path)
    return read_placed(tmp_path)


def with_focals(placed, focals):
    """The photos with cameras that their parts have refined differently."""
    cameras = {}
    for photo, focal in zip(placed.photos.tolist(), focals, strict=True):
        cameras[photo] = pycolmap.Camera(placed.cameras[photo].todict())
        cameras[photo].params = [focal, *cameras[photo].params[1:]]
    return replace(placed, cameras=cameras)


def test_a_model_is_the_same_as_arrays_and_back(synthetic, placed):
    found = write_placed(synthetic.database, placed)

    (poses, points), (true, seen) = poses_and_points(found), poses_and_points(synthetic.model)
    assert list(poses) == list(true) == placed.photos.tolist()
    assert all(np.allclose(poses[photo], true[photo], atol=1e-12) for photo in true)
    assert np.allclose(points, seen)
    assert found.compute_num_observations() == synthetic.model.compute_num_observations() == len(placed.photo)
    found.update_point_3d_errors()
    assert 0.2 < found.compute_mean_reprojection_error() < 0.3


def test_photos_that_share_a_camera_get_the_one_with_the_median_focal(synthetic, placed):
    found = write_placed(synthetic.database, with_focals(placed, [1200, 1290, 1400, 1275, 1285, 1270]))

    (camera,) = found.cameras.values()
    assert camera.params[0] == 1285


@pytest.mark.parametrize(("refined", "focal"), [((), 1305.0), ((1,), 1280.0)])
def test_settling_brings_joined_parts_together(synthetic, placed, refined, focal):
    rng = np.random.default_rng(2)
    size = np.linalg.norm(placed.centers - placed.centers.mean(axis=0), axis=1).max()
    off = replace(placed, centers=placed.centers + rng.normal(scale=0.01 * size, size=placed.centers.shape))
    model = write_placed(synthetic.database, with_focals(off, [1305.0] * 6))

    adjust_joined(model, synthetic.database, refined)

    (camera,) = model.cameras.values()
    assert camera.params[0] == pytest.approx(focal, rel=0.005 if refined else 1e-12)
    true = placed.centers
    got = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses_and_points(model)[0].values()])
    assert np.linalg.norm(umeyama(got, true)(got) - true, axis=1).max() < 0.005 * size
    assert model.num_points3D() > 90
