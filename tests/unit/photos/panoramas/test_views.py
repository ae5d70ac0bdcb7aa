"""Perspective views into panoramas show the right directions, across the seam and at the poles, too."""

import numpy as np
import pytest

from sfm_app.photos.panoramas import PanoramaViews, mask_part, panorama_parts, resample, show_part, shrink

WIDTH = 512


def colors_of(rays):
    """Colors (..., 3) of rays of any length: each channel is an axis."""
    return np.round(127.5 + 120.0 * rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.uint8)


def panorama(width=WIDTH):
    """A panorama whose colors are directions."""
    across = ((np.arange(width) + 0.5) / width - 0.5) * 2.0 * np.pi
    longitude, latitude = np.meshgrid(across, 0.5 * across[::2] + 0.25 * (across[1] - across[0]))
    level = np.cos(latitude)
    return colors_of(np.stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)], -1))


def test_painted_parts_show_their_directions_all_round():
    whole = panorama()

    parts = panorama_parts((WIDTH, WIDTH // 2))

    assert len(parts) == 6
    for part in parts:
        wrong = np.abs(show_part(whole, part).astype(int) - colors_of(part.rays()))
        assert wrong.max() <= 4 and wrong.mean() < 1.0


def test_masks_of_parts_are_those_of_their_pixels():
    used = np.ones((WIDTH // 2, WIDTH), np.bool_)
    used[:, : WIDTH // 2] = False  # the left half

    for part in panorama_parts((WIDTH, WIDTH // 2)):
        rays = part.rays()
        clear = np.abs(rays[..., 0]) > 0.02
        np.testing.assert_array_equal(mask_part(used, part)[clear], rays[..., 0][clear] > 0.0)


@pytest.mark.parametrize("view", range(12))
def test_feature_views_show_their_directions(view):
    views = PanoramaViews.cover((WIDTH, WIDTH // 2), 1000)

    shown = views.render(panorama(), view)

    pixels = np.array([[0.5, 0.5], [views.side_px / 2, views.side_px / 2], [views.side_px - 0.5, 0.5]])
    plain = np.column_stack([(pixels - views.side_px / 2) / views.focal_px, np.ones(3)])
    column, row = pixels.astype(int).T
    wrong = np.abs(shown[row, column].astype(int) - colors_of(plain @ views.rotations[view]))
    assert wrong.max() <= 4


def test_every_direction_belongs_to_one_feature_view():
    views = PanoramaViews.cover((WIDTH, WIDTH // 2), 1000)
    pixels = np.random.default_rng(0).uniform(0.0, views.side_px, (4000, 2))

    own = [views.is_nearest(pixels, view) for view in range(12)]

    # a view of 90 degrees is a fifth of the sphere of which a twelfth is its own
    assert all(0.3 < share.mean() < 0.7 for share in own)
    at = np.concatenate([views.to_panorama(pixels[mine], view) for view, mine in enumerate(own)])
    cells = np.histogram2d(*(at / [WIDTH, WIDTH / 2]).T, bins=(8, 4))[0]
    assert cells.min() > 0


def test_sampling_goes_around_the_border_of_a_panorama():
    photo = np.zeros((20, 40, 3), np.uint8)
    photo[:, -1] = photo[:, 0] = 200
    at = np.array([[[0.0, 10.0], [40.0, 10.0], [20.0, 10.0]]])

    assert resample(photo, at, (40, 20), wraps=True)[0, :, 0].tolist() == pytest.approx([230, 230, 0], abs=12)
    assert resample(photo, at, (40, 20))[0, 0, 0] > 190


def test_shrinking_averages_and_never_enlarges():
    photo = np.zeros((10, 20, 3), np.uint8)
    photo[:, ::2] = 200

    assert shrink(photo, 0.5).shape == (5, 10, 3) and (shrink(photo, 0.5) == 100).all()
    assert shrink(photo, 1.5) is photo
