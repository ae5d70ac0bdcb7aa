import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix, rays

K = camera_matrix(900.0, 850.0, 480.0, 330.0)


@pytest.mark.parametrize("radial", [-0.3, -0.05, 0.0, 0.2, 1.5])
def test_rays_come_back_through_the_lens(radial):
    straight = np.random.default_rng(0).uniform(-0.55, 0.55, (200, 2))
    straight[0] = 0.0
    bent = straight * (1 + radial * (straight**2).sum(axis=1, keepdims=True))

    found = rays(bent * [900, 850] + [480, 330], K, radial)

    assert np.allclose(found, straight, atol=1e-10)


def test_what_lies_beyond_the_fold_of_a_lens_lies_on_it():
    x = np.column_stack([np.linspace(480, 960, 50), np.full(50, 330.0)])  # up to 0.53; r - r^3 never exceeds 0.385

    found = rays(x, K, -1.0)[:, 0]

    assert np.all(np.diff(found[:30]) > 0)
    assert found[-1] == pytest.approx(3**-0.5)
