"""Inputs of parts as files: what is read back is what was written, and the same inputs are the same bytes."""

import json

import numpy as np

from sfm_app.mapping.attempt import Group
from sfm_app.mapping.part_mapping import (
    PartInputs,
    joins_from_plain,
    joins_to_plain,
    pairs_of_parts,
    part_of_group,
    read_inputs,
    write_inputs,
)
from sfm_app.settings import Settings
from sfm_app.types import Calibration, Intrinsics, LookAlikes, PoseGraph, RelativePose
from tests.unit.reconstruction.parts.conftest import K


def group_of(street):
    matches, views = street.graphs()
    poses = {
        pair: RelativePose(np.eye(3), np.array([0.6, 0.0, 0.8]), fit.inliers, 3.25, 0.9, "planar", sum(pair) % 2 == 0)
        for pair, fit in views.fits.items()
    }
    lens = Calibration(K, 1200, 900, "zero-curves", True, spread={"fx": 1.5}, key_pairs=((1, 2),))
    other = Calibration(K, 640, 480, "guess", False)
    intrinsics = Intrinsics({"one": lens, "two": other}, {"040.jpg": "two"})
    return Group(tuple(matches.images), matches, views, PoseGraph(poses, {}, ()), intrinsics)


def test_a_part_of_a_group_has_what_concerns_its_photos(street):
    group = group_of(street)
    pairs, _ = pairs_of_parts(group.matches.matches, [(3, 4, 5), (5, 6)])
    part = part_of_group(group, (3, 4, 5), pairs)

    assert list(part.matches.images) == list(part.matches.keypoints) == [3, 4, 5]
    assert list(part.matches.matches) == list(part.views.fits) == list(part.graph.poses) == [(3, 4), (3, 5), (4, 5)]
    assert part.graph.groups == ((3, 4, 5),) and list(part.intrinsics.cameras) == ["one"]


def test_pairs_belong_to_every_part_that_has_both_photos():
    pairs = [(1, 2), (2, 3), (3, 4), (1, 4), (4, 5)]

    assert pairs_of_parts(pairs, [(1, 2, 3), (2, 3, 4), (9,)]) == [[(1, 2), (2, 3)], [(2, 3), (3, 4)], []]


def test_inputs_are_read_back_as_they_were(street, tmp_path):
    group = group_of(street)
    (pairs,) = pairs_of_parts(group.matches.matches, [range(21, 41)])
    part = part_of_group(group, range(21, 41), pairs)
    settings = Settings.from_mapping({"seed": 7, "scene": {"part_photos": 33}})

    write_inputs(
        tmp_path / "a.npz", PartInputs(part, frozenset([(21, 22), (21, 23)]), settings, stop_at_false_joins=True)
    )
    write_inputs(
        tmp_path / "b.npz", PartInputs(part, frozenset([(21, 23), (21, 22)]), settings, stop_at_false_joins=True)
    )
    again = read_inputs(tmp_path / "a.npz")
    found = again.part

    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert again.mapped == {(21, 22), (21, 23)} and again.settings == settings and again.stop_at_false_joins
    assert found.photos == part.photos and found.matches.images == part.matches.images
    assert list(found.matches.matches) == list(part.matches.matches)
    assert all(np.array_equal(found.matches.matches[pair], rows) for pair, rows in part.matches.matches.items())
    assert all(np.array_equal(found.matches.keypoints[photo], x) for photo, x in part.matches.keypoints.items())
    assert all(np.array_equal(found.views.fits[pair].F, fit.F) for pair, fit in part.views.fits.items())
    for pair, pose in part.graph.poses.items():
        read = found.graph.poses[pair]
        assert np.array_equal(read.R, pose.R) and np.array_equal(read.t, pose.t)
        assert np.array_equal(read.inliers, pose.inliers)
        assert (read.angle_deg, read.in_front, read.kind, read.guided) == (3.25, 0.9, "planar", sum(pair) % 2 == 0)
    assert found.intrinsics.to_dict() == part.intrinsics.to_dict()


def test_false_joins_travel_as_plain_values():
    joins = (LookAlikes(((1, 2), (3, 4)), 0.875), LookAlikes(((5, 6),), 0.5))

    assert joins_from_plain(json.loads(json.dumps(joins_to_plain(joins)))) == joins
