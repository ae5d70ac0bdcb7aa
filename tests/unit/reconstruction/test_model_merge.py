"""Joining models: two halves of COLMAP's synthetic model, one of them elsewhere and in another unit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.colmap.database import write_match_graph
from sfm_app.colmap.model import move, posed_photo_ids, poses_and_points, submodel
from sfm_app.geometry.poses import Similarity, umeyama
from sfm_app.mapping import passes
from sfm_app.mapping.attempt import judge_model
from sfm_app.mapping.split_and_merge import OPTIONS, merge_into_main, shared_points
from sfm_app.types import ViewGraph

pytestmark = pytest.mark.slow

ELSEWHERE = Similarity(3.7, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([5.0, -2.0, 11.0]))


@pytest.fixture
def halves(synthetic, run):
    """Photos 1 to 3, and 4 to 6 elsewhere."""
    first, second = submodel(synthetic.model, (1, 2, 3)), submodel(synthetic.model, (4, 5, 6))
    move(second, ELSEWHERE)
    return tuple(
        judge_model(synthetic.matches, synthetic.views, "incremental", "half", model, run())
        for model in (first, second)
    )


def within(pair):
    """Whether both photos are of one half."""
    return (pair[0] <= 3) == (pair[1] <= 3)


def centers(model):
    return np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses_and_points(model)[0].values()])


def test_points_that_both_know_are_found_once_with_both_their_places(synthetic, halves):
    shared = shared_points(halves[0].model, halves[1].model, synthetic.matches, synthetic.views)

    assert 50 < len(shared) <= halves[0].model.num_points3D()
    assert np.allclose(ELSEWHERE(shared[:, :3]), shared[:, 3:], atol=0.2)


def test_halves_become_one_model_as_exact_as_the_whole(synthetic, halves, run):
    (found,) = merge_into_main(halves, synthetic.matches, synthetic.views, run())

    assert posed_photo_ids(found.model) == [1, 2, 3, 4, 5, 6]
    assert found.note.startswith("3 and 3 photos joined by ")
    true, got = centers(synthetic.model), centers(found.model)
    size = np.linalg.norm(true - true.mean(axis=0), axis=1).max()
    assert np.linalg.norm(umeyama(got, true)(got) - true, axis=1).max() < 0.005 * size
    assert 0.05 < found.model.compute_mean_reprojection_error() < 0.5


def test_what_shares_too_few_points_stays_apart(synthetic, halves, run):
    views = ViewGraph({pair: fit for pair, fit in synthetic.views.fits.items() if within(pair)}, {})

    assert len(shared_points(halves[0].model, halves[1].model, synthetic.matches, views)) < OPTIONS.min_shared
    assert merge_into_main(halves, synthetic.matches, views, run()) == halves


def test_matches_that_disagree_about_the_place_join_nothing(synthetic, halves, run):
    rng = np.random.default_rng(1)
    rows = {
        pair: row if within(pair) else np.column_stack([row[:, 0], rng.permutation(row[:, 1])])
        for pair, row in synthetic.matches.matches.items()
    }

    assert merge_into_main(halves, replace(synthetic.matches, matches=rows), synthetic.views, run()) == halves


def test_models_that_mapping_left_apart_are_joined_in_the_end(synthetic, halves, run, cameras):
    made = passes.Outcome(halves, _graph(synthetic), cameras(), ("half", "half"))

    context = run()
    write_match_graph(context.workspace.database, synthetic.matches)

    found = passes.Passes(context).merge_models(made, synthetic.matches, synthetic.views)

    assert [model.photos for model in found.models] == [6]
    assert found.reason == found.tried[-1] == found.models[0].note
    assert len(found.graph.poses) == 15


def _graph(synthetic):
    return passes.PoseGraph({}, {}, tuple((photo,) for photo in synthetic.matches.images))
