"""Joins of fragments, their common frame, and the merged model."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.joined_model import PlacedPhotos, adjust_joined, read_placed, write_placed
from sfm_app.colmap.model import poses_and_points
from sfm_app.geometry.poses import Similarity, umeyama
from sfm_app.mapping.joins import AcrossJoins, Fragment, Join, align_fragments, find_join, join_error, merge_fragments


def difference_of(found, true):
    """Errors of the angle in degrees, of the scale, and of where a point 10 units away ends."""
    angle = np.degrees(Rotation.from_matrix(found.R @ true.R.T).magnitude())
    at = true.inverse()(np.array([[10.0, 0.0, 3.0]]))
    return angle, abs(found.scale / true.scale - 1.0), float(np.linalg.norm(found(at) - true(at)))


def test_a_join_recovers_the_similarity(two_parts):
    join = find_join(0, 1, two_parts.fragments)
    assert (join.first, join.second, join.photos, join.shared) == (0, 1, 8, 8)
    angle, scale, place = difference_of(join.similarity, two_parts.true)
    assert angle < 0.3 and scale < 0.01 and 0.0 < place < 0.05
    assert 100 < join.points <= 600
    assert 0.01 < join.off_deg < 0.5 and 0.0005 < join.off < 0.01
    assert np.allclose(two_parts.true(join.middle)[0, 0], 9.75, atol=0.2)


def test_photos_that_one_part_has_misplaced_do_not_count(two_parts):
    first, second = two_parts.fragments
    centers = second.placed.centers.copy()
    centers[:3] += np.array([0.0, 3.0, 1.0])  # of eight shared photos
    moved = replace(second, placed=replace(second.placed, centers=centers))
    join = find_join(0, 1, [first, moved])
    assert (join.photos, join.shared) == (5, 8)
    angle, scale, place = difference_of(join.similarity, two_parts.true)
    assert angle < 0.3 and scale < 0.01 and place < 0.05


@pytest.mark.parametrize("shared", [0, 2, 3])
def test_three_shared_photos_join_two_do_not(street, shared):
    first = Fragment(0, frozenset(range(1, 21)), street.placed(range(1, 21)))
    second = Fragment(1, frozenset(range(21, 41)), street.placed(range(21 - shared, 41)))
    assert (find_join(0, 1, [first, second]) is not None) is (shared == 3)


def test_matches_across_bear_out_a_right_join_and_contradict_a_wrong_one(street, two_parts):
    across = AcrossJoins(*street.graphs(), 1.5)
    join = find_join(0, 1, two_parts.fragments)
    explained, contradicted = across.count(join, two_parts.fragments)
    assert explained > 800 and contradicted < 0.01 * explained
    aside = Similarity(join.similarity.scale, join.similarity.R, join.similarity.t + np.array([0.0, 3.0, 0.0]))
    explained, contradicted = across.count(replace(join, similarity=aside), two_parts.fragments)
    assert contradicted > 3 * explained


COUNT = 8
EMPTY = np.zeros(0, np.int64)


def random_similarity(rng, turn=2.0, spread=0.5, shift=1.0):
    R = Rotation.from_rotvec(rng.normal(scale=turn, size=3)).as_matrix()
    return Similarity(float(np.exp(rng.normal(scale=spread))), R, rng.normal(scale=shift, size=3))


def fragment(number, frame, rng):
    """Ten photos, about 1 from their middle in the common frame."""
    centers = frame.inverse()(frame.t + rng.normal(scale=0.6, size=(10, 3)))
    photos = 10 * number + np.arange(10)
    placed = PlacedPhotos(photos, np.tile(np.eye(3), (10, 1, 1)), centers, np.zeros((0, 3)), EMPTY, EMPTY, EMPTY, {})
    return Fragment(number, frozenset(photos.tolist()), placed)


@pytest.fixture
def ring():
    """Fragments, their true frames, and joins to the next and the next but one, in a ring, with noise."""
    rng = np.random.default_rng(3)
    places = [3.0 * np.array([np.cos(angle), 0.1, np.sin(angle)]) for angle in 2 * np.pi * np.arange(COUNT) / COUNT]
    true = [replace(random_similarity(rng), t=place) for place in places]
    pairs = sorted({tuple(sorted((k, (k + step) % COUNT))) for k in range(COUNT) for step in (1, 2)})
    joins = []
    for a, b in pairs:
        noise = random_similarity(rng, turn=0.003, spread=0.005, shift=0.01)
        # the noise acts about the place between the two, in the common frame
        middle = (places[a] + places[b]) / 2
        about = Similarity(noise.scale, noise.R, middle - noise.scale * noise.R @ middle + noise.t)
        found = true[a].inverse().compose(about).compose(true[b])
        joins.append(Join(a, b, found, 8, 10, 100, 0.2, 0.01, true[b].inverse()(middle[None]), 400, 10))
    return [fragment(k, true[k], rng) for k in range(COUNT)], true, joins


def off(frames, true):
    """Largest errors of angle, logarithm of scale and shift, against the truth in the frame of the first."""
    expected = {k: true[0].inverse().compose(one) for k, one in enumerate(true)}
    found = {k: frames[0].inverse().compose(one) for k, one in frames.items()}
    angles = [Rotation.from_matrix(found[k].R @ expected[k].R.T).magnitude() for k in found]
    scales = [abs(np.log(found[k].scale / expected[k].scale)) for k in found]
    shifts = [np.linalg.norm(found[k].t - expected[k].t) * true[0].scale for k in found]
    return np.degrees(max(angles)), max(scales), max(shifts)


def test_frames_are_as_exact_as_the_joins(ring):
    fragments, true, joins = ring
    found = align_fragments(fragments, joins)
    assert not found.dropped and len(found.kept) == len(joins)
    angle, scale, shift = off(found.frames, true)
    assert 0.01 < angle < 1.0 and 0.0005 < scale < 0.03 and 0.001 < shift < 0.15


WRONG = {
    "rotation": lambda s: Similarity(s.scale, Rotation.from_euler("y", 90, degrees=True).as_matrix() @ s.R, s.t),
    "scale": lambda s: Similarity(1.6 * s.scale, s.R, s.t),
    "place": lambda s: Similarity(s.scale, s.R, s.t + 1.5 * s.scale * s.R @ np.array([1.0, 0.0, 0.0])),
}


@pytest.mark.parametrize("what", WRONG)
def test_loops_find_a_wrong_join(ring, what):
    fragments, true, joins = ring
    wrong = replace(joins[5], similarity=WRONG[what](joins[5].similarity))
    found = align_fragments(fragments, [*joins[:5], wrong, *joins[6:]])
    assert found.dropped == (wrong,)
    radii = [fragment.radius for fragment in fragments]
    implied = {join: found.frames[join.first].inverse().compose(found.frames[join.second]) for join in joins}
    assert join_error(wrong, implied[joins[5]], radii) > 1.0
    assert all(join_error(join, implied[join], radii) < 0.5 for join in found.kept)
    angle, scale, shift = off(found.frames, true)
    assert angle < 1.0 and scale < 0.03 and shift < 0.2


def test_a_street_folded_onto_another_is_found_by_its_loop(ring):
    """A plain ring, and a chord of look-alikes with less evidence across it."""
    fragments, true, joins = ring
    plain = [join for join in joins if (join.second - join.first) in (1, COUNT - 1)]
    chord = Join(0, 4, Similarity(1.0, np.eye(3), np.zeros(3)), 4, 5, 40, 0.3, 0.02, np.zeros((1, 3)), 30, 0)
    found = align_fragments(fragments, [*plain, chord])
    assert found.dropped == (chord,)
    assert len(found.frames) == COUNT and off(found.frames, true)[0] < 2.0


def test_what_no_join_connects_has_no_frame(ring):
    fragments, _, joins = ring
    within = [join for join in joins if join.first >= 2 and join.second >= 2]
    found = align_fragments(fragments, within)
    assert sorted(found.frames) == [2, 3, 4, 5, 6, 7]
    assert sorted(align_fragments(fragments, []).frames) == [0]


STILL = Similarity(1.0, np.eye(3), np.zeros(3))


def test_every_photo_is_there_once_where_it_belongs(street, two_parts):
    found = merge_fragments(two_parts.fragments, {0: STILL, 1: two_parts.true})
    assert found.photos.tolist() == list(range(1, 41))
    away = np.linalg.norm(found.centers - street.centers, axis=1)
    assert 0.001 < away.max() < 0.06
    owned = two_parts.true(two_parts.fragments[1].placed.centers)
    assert np.allclose(found.centers[20:], owned[4:])  # 17 to 20 are owned by the first part
    assert np.allclose(np.einsum("nji,njk->nik", found.R, street.R), np.eye(3), atol=0.02)


def test_tracks_with_a_keypoint_in_common_become_one(street, two_parts):
    found = merge_fragments(two_parts.fragments, {0: STILL, 1: two_parts.true})
    views = np.bincount(np.concatenate([street.seen[k] for k in range(40)]), minlength=len(street.X))
    assert len(found.X) == np.count_nonzero(views >= 2)
    assert sorted(np.bincount(found.point)) == sorted(views[views >= 2])
    true = street.X[found.keypoint[np.searchsorted(found.point, np.arange(len(found.X)))]]
    assert np.linalg.norm(found.X - true, axis=1).max() < 0.06
    assert len(np.unique(found.photo * 10_000 + found.keypoint)) == len(found.photo)
    assert (np.diff(found.point) >= 0).all()


def test_a_part_that_has_a_photo_elsewhere_does_not_say_what_it_sees(street, two_parts):
    first, second = two_parts.fragments
    centers = second.placed.centers.copy()
    centers[0] += 5.0
    wrong = [first, replace(second, placed=replace(second.placed, centers=centers))]
    found = merge_fragments(wrong, {0: STILL, 1: two_parts.true})
    assert np.linalg.norm(found.centers - street.centers, axis=1).max() < 0.06
    # photo 17 now sees only what the first part has triangulated
    assert set(found.keypoint[found.photo == 17]) <= set(first.placed.keypoint[first.placed.photo == 17])


def test_two_keypoints_of_a_photo_do_not_end_in_one_point(two_parts):
    first, second = two_parts.fragments
    keypoint = second.placed.keypoint.copy()
    (twice,) = np.flatnonzero((second.placed.photo == 18) & (keypoint == keypoint[second.placed.photo == 18][5]))
    keypoint[twice] = 5000  # another keypoint of photo 18, in the track of a point that the first part also has
    changed = [first, replace(second, placed=replace(second.placed, keypoint=keypoint))]
    found = merge_fragments(changed, {0: STILL, 1: two_parts.true})
    pairs = found.point * 100 + found.photo
    assert len(np.unique(pairs)) == len(pairs)
    assert np.bincount(found.point).min() >= 2


def test_what_has_no_frame_stays_out(two_parts):
    found = merge_fragments(two_parts.fragments, {1: STILL})
    assert found.photos.tolist() == list(range(17, 41))
    assert np.allclose(found.centers, two_parts.fragments[1].placed.centers)


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


@pytest.mark.slow
def test_a_model_is_the_same_as_arrays_and_back(synthetic, placed):
    found = write_placed(synthetic.database, placed)
    (poses, points), (true, seen) = poses_and_points(found), poses_and_points(synthetic.model)
    assert list(poses) == list(true) == placed.photos.tolist()
    assert all(np.allclose(poses[photo], true[photo], atol=1e-12) for photo in true)
    assert np.allclose(points, seen)
    assert found.compute_num_observations() == synthetic.model.compute_num_observations() == len(placed.photo)
    found.update_point_3d_errors()
    assert 0.2 < found.compute_mean_reprojection_error() < 0.3


@pytest.mark.slow
def test_photos_that_share_a_camera_get_the_one_with_the_median_focal(synthetic, placed):
    found = write_placed(synthetic.database, with_focals(placed, [1200, 1290, 1400, 1275, 1285, 1270]))
    (camera,) = found.cameras.values()
    assert camera.params[0] == 1285


@pytest.mark.slow
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
