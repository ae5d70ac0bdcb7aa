from dataclasses import replace

import numpy as np
import pytest

from sfm_app.errors import NumericalError
from sfm_app.geometry.poses import Similarity
from sfm_app.synthetic.cameras import axis_rotation, make_camera
from sfm_app.synthetic.compare import (
    align_centers,
    center_error_percent,
    focal_error_percent,
    sample_surface,
    scene_size,
    seen_points,
    surface_errors,
)
from sfm_app.synthetic.photo_folder import Truth


def random_similarity(rng):
    axis = rng.normal(size=3)
    R = axis_rotation(axis / np.linalg.norm(axis), rng.uniform(-180, 180))
    return Similarity(float(np.exp(rng.uniform(-3, 3))), R, rng.normal(size=3) * 10)


def moved(truth, similarity):
    """The truth as a reconstruction would have it: in a frame of its own."""
    centers = {name: similarity(c[None])[0] for name, c in truth.centers.items()}
    return similarity(truth.vertices), truth.faces, centers


@pytest.fixture(scope="module")
def plane_truth(photos):
    """A square of side 4 in the ground plane, seen by the four views."""
    vertices = np.array([[-2.0, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]])
    return replace(photos[1], vertices=vertices, faces=np.array([[0, 1, 2], [0, 2, 3]]))


def test_errors_of_K_are_those_of_the_thesis(photos):
    truth = photos[1]
    K = truth.K.copy()
    assert focal_error_percent(K, truth) == center_error_percent(K, truth) == 0.0
    K[0, 0] *= 1.02
    K[1, 1] *= 0.96
    K[0, 2] *= 0.9
    assert focal_error_percent(K, truth) == pytest.approx(3.0)
    assert center_error_percent(K, truth) == pytest.approx(5.0)


@pytest.mark.parametrize("wrong", [0, 3])
def test_wrong_photos_do_not_spoil_the_alignment(wrong):
    rng = np.random.default_rng(5)
    true = random_similarity(rng)
    found = rng.normal(size=(12, 3))
    right = true(found)
    names = [f"{k}.jpg" for k in range(12)]
    poses = {name: np.column_stack([np.eye(3), -c]) for name, c in zip(names, right, strict=True)}
    truth = Truth(dict.fromkeys(names, make_camera(96, 64)), poses, np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    noisy = found + rng.normal(scale=1e-3, size=found.shape)
    noisy[:wrong] += rng.normal(size=(wrong, 3)) * 3

    similarity = align_centers(dict(zip(names, noisy, strict=True)), truth)

    error = np.linalg.norm(similarity(noisy[wrong:]) - right[wrong:], axis=1) / true.scale
    assert 2e-4 < np.sqrt(np.mean(error**2)) < 4e-3, "what is left is the noise"


def test_alignment_needs_three_known_photos_off_a_line(photos):
    truth = photos[1]
    two = dict(list(truth.centers.items())[:2]) | {"stranger.jpg": np.zeros(3)}
    with pytest.raises(ValueError, match="2 of the estimated camera centers"):
        align_centers(two, truth)
    on_a_line = {name: np.array([float(k), 0.0, 0.0]) for k, name in enumerate(truth.centers)}
    with pytest.raises(NumericalError, match="on a line"):
        align_centers(on_a_line, truth)


@pytest.mark.parametrize("seed", range(2))
def test_the_truth_in_another_frame_has_no_error(photos, seed):
    vertices, faces, centers = moved(photos[1], random_similarity(np.random.default_rng(seed)))
    to_truth, to_found = surface_errors(vertices, faces, centers, photos[1])
    assert len(to_truth) == 20_000 and to_truth.max() < 1e-5 and to_found.max() < 1e-5


@pytest.mark.parametrize("offset", [0.01, 0.1])
def test_the_error_is_the_distance_over_the_scene_size(plane_truth, offset):
    raised = plane_truth.vertices + np.array([0.0, offset, 0.0])
    to_truth, to_found = surface_errors(raised, plane_truth.faces, plane_truth.centers, plane_truth)
    assert to_truth == pytest.approx(offset / scene_size(plane_truth), rel=1e-3)
    assert to_found == pytest.approx(offset / scene_size(plane_truth), rel=1e-2)


def test_a_share_of_the_errors_is_a_share_of_the_area(plane_truth):
    size = scene_size(plane_truth)
    # a third of the surface's area is 0.6 % of the size above the truth, the rest 0.4 %
    above = np.array([0.0, 0.006 * size, 0.0]), np.array([0.0, 0.004 * size, 0.0])
    vertices = np.concatenate([plane_truth.vertices + offset for offset in above])
    faces = np.concatenate([plane_truth.faces[:1], plane_truth.faces + 4])
    to_truth, _ = surface_errors(vertices, faces, plane_truth.centers, plane_truth)
    assert np.mean(to_truth <= 0.005) == pytest.approx(2 / 3, abs=0.02)
    assert 0.0039 < to_truth.min() < to_truth.max() < 0.0061


def test_missing_parts_tell_half_a_surface_from_a_whole_one(plane_truth):
    half = plane_truth.faces[:1]
    to_truth, to_found = surface_errors(plane_truth.vertices, half, plane_truth.centers, plane_truth)
    assert np.median(to_truth) < 1e-6 and 0.3 < np.mean(to_found <= 1e-4) < 0.7


def test_the_scene_is_what_the_photos_see(photos, plane_truth):
    truth = photos[1]
    hidden = np.array([[50.0, 0, 50], [51, 0, 50], [50, 0, 51]])
    faces = np.concatenate([truth.faces, np.array([[0, 1, 2]]) + len(truth.vertices)])
    behind = replace(truth, vertices=np.concatenate([truth.vertices, hidden]), faces=faces)
    assert scene_size(behind) == scene_size(truth) and 4.0 < scene_size(plane_truth) <= 32**0.5 + 1e-3
    assert np.abs(seen_points(plane_truth)[:, 1]).max() < 1e-5


def test_samples_spread_evenly_over_the_triangles():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 0, 0], [0, 3, 0]])
    faces = np.array([[0, 1, 2], [0, 3, 4]])  # areas 1/2 and 9/2
    points, triangles = sample_surface(vertices, faces, 20_000)
    assert np.mean(triangles == 0) == pytest.approx(0.1, abs=0.01)
    inner = points.sum(axis=1) <= 1.0
    # all of the small triangle's share, and a ninth of the big one's
    assert inner.mean() == pytest.approx(0.1 + 0.9 / 9, abs=0.01)
    assert np.all(points >= 0) and points.sum(axis=1).max() <= 3 and not points[:, 2].any()
    assert np.allclose(points[~inner].mean(axis=0)[0], points[~inner].mean(axis=0)[1], atol=0.03)


def test_a_surface_without_area_is_refused(photos):
    truth = photos[1]
    nothing = np.zeros((0, 3), dtype=np.int64)
    with pytest.raises(ValueError, match="no area"):
        surface_errors(truth.vertices, nothing, truth.centers, truth)
