import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.mapping.attempt import PairSupport, explained_pairs, model_poses, support
from sfm_app.types import MatchGraph, ViewGraph


def explained(model, synthetic, views=None):
    return explained_pairs(model, synthetic.matches, views or synthetic.views, 1.5)


def turned(model, photo, degrees):
    """Turn a photo on the spot."""
    pose = model.images[photo].cam_from_world()
    turn = pycolmap.Rotation3d(np.radians(degrees) * np.array([0.0, 1.0, 0.0]))
    model.frames[model.images[photo].frame_id].rig_from_world = pycolmap.Rigid3d(turn, np.zeros(3)) * pose


def test_the_true_model_explains_all_right_matches_and_contradicts_none(synthetic):
    found = explained(synthetic.model, synthetic)

    assert list(found) == list(synthetic.matches.matches)
    assert all(pair.inliers == 100 and pair.contradicted == 0 for pair in found.values())
    assert all(100 <= pair.matches <= 115 for pair in found.values())
    assert np.mean([pair.matches for pair in found.values()]) < 108  # 20 matches of each pair are false


def test_a_photo_that_looks_the_wrong_way_contradicts_its_pairs_and_no_others(synthetic):
    model = synthetic.copy()
    turned(model, 3, 5.0)

    found = explained(model, synthetic)

    for pair, counts in found.items():
        assert (counts.contradicted > 60) == (3 in pair), pair
        assert (counts.matches < 50) == (3 in pair), pair
    assert support(found) < 0.8 * support(explained(synthetic.model, synthetic))


def test_points_behind_a_camera_are_not_explained(synthetic):
    """With photo 2 beyond photo 1 on the other side, epipolar lines stay and points change sides."""
    model = synthetic.copy()
    first, second = (model.images[key].cam_from_world().matrix() for key in (1, 2))
    center = [-pose[:, :3].T @ pose[:, 3] for pose in (first, second)]
    there = 2.0 * center[0] - center[1]
    moved = pycolmap.Rigid3d(pycolmap.Rotation3d(second[:, :3]), -second[:, :3] @ there)
    model.frames[model.images[2].frame_id].rig_from_world = moved

    found = explained(model, synthetic)

    assert found[1, 2].matches < 10 and found[1, 2].contradicted == 100


def test_only_pairs_of_photos_with_a_place_are_asked(synthetic):
    model = synthetic.copy()
    model.deregister_frame(model.images[6].frame_id)

    assert set(explained(model, synthetic)) == {pair for pair in synthetic.matches.matches if 6 not in pair}


def test_a_pair_without_F_contradicts_nothing_but_counts(synthetic):
    fits = {pair: fit for pair, fit in synthetic.views.fits.items() if pair != (1, 2)}

    found = explained(synthetic.model, synthetic, ViewGraph(fits, {}))[1, 2]

    assert (found.inliers, found.contradicted) == (0, 0) and found.matches >= 100


def test_a_model_does_not_explain_matches_that_nobody_made(synthetic):
    rows = {pair: row[100:] for pair, row in synthetic.matches.matches.items()}
    matches = MatchGraph(synthetic.matches.images, synthetic.matches.keypoints, rows)

    found = explained_pairs(synthetic.model, matches, ViewGraph({}, {}), 1.5)

    assert sum(pair.matches for pair in found.values()) < 0.3 * 20 * len(found)


def pairs(*counts):
    return {(0, k): PairSupport(count, count, 0) for k, count in enumerate(counts, start=1)}


def test_many_matches_of_one_pair_count_less_than_some_of_many():
    assert support(pairs(100)) == pytest.approx(50)
    assert support(pairs(1000)) == pytest.approx(1000 / 11)
    assert support(pairs(60, 60, 60)) > support(pairs(1000))
    assert support(pairs(60, 61)) > support(pairs(60, 60))
    assert support({}) == 0.0


def test_relative_poses_of_a_model_are_those_of_its_photos_with_the_matches_that_lie_right(synthetic):
    found = model_poses(synthetic.model, synthetic.matches, 1.5, 100)

    first, second = (synthetic.model.images[photo].cam_from_world().matrix() for photo in (1, 2))
    R = second[:, :3] @ first[:, :3].T
    t = second[:, 3] - R @ first[:, 3]
    assert list(found) == list(synthetic.matches.matches)
    np.testing.assert_allclose(found[1, 2].R, R, atol=1e-12)
    np.testing.assert_allclose(found[1, 2].t, t / np.linalg.norm(t), atol=1e-12)
    assert all(pose.inliers[:100].mean() > 0.98 and pose.inliers[100:].mean() < 0.5 for pose in found.values())


def test_pairs_of_a_model_that_share_little_have_no_relative_pose(synthetic):
    assert model_poses(synthetic.model, synthetic.matches, 1.5, 121) == {}
