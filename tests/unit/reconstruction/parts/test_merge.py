"""Merging fragments: photos once, tracks by keypoint."""

from dataclasses import replace

import numpy as np

from sfm_app.geometry.poses import Similarity
from sfm_app.mapping.joins import merge_fragments

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
