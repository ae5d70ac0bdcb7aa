"""A model as plain arrays: what they say together is what COLMAP's model says."""

import numpy as np
import pytest

from sfm_app.colmap.model import model_arrays


def test_points_fall_on_the_pixels_of_their_tracks(synthetic):
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


def test_photos_look_from_their_centers(synthetic):
    model, _ = synthetic()
    found = model_arrays(model, metric=False)
    true = {image.name: image.projection_center() for image in model.images.values()}
    assert np.allclose(found.centers, [true[name] for name in found.photos])
    assert found.sizes.tolist() == [[1000, 800]] * 8
    assert not found.metric


def test_a_model_without_points_has_empty_arrays(synthetic):
    model, _ = synthetic()
    for key in list(model.points3D):
        model.delete_point3D(key)
    found = model_arrays(model, metric=False)
    assert found.points.shape == (0, 3)
    assert found.track_pixels.shape == (0, 2)
    assert found.track_points.shape == (0,)
    assert found.errors_px == pytest.approx([])
