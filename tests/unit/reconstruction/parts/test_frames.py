"""Frames of fragments from their joins: known similarities with noise, and planted wrong joins."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.colmap.joined_model import PlacedPhotos
from sfm_app.geometry.poses import Similarity
from sfm_app.mapping.joins import Fragment, Join, align_fragments, loop_errors

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

    assert [join for join, _ in found.dropped] == [wrong]
    assert found.dropped[0][1].excess > 1.0
    assert all(error.excess < 0.5 for _, error in found.kept)
    angle, scale, shift = off(found.frames, true)
    assert angle < 1.0 and scale < 0.03 and shift < 0.2


def test_a_street_folded_onto_another_is_found_by_its_loop(ring):
    """A plain ring, and a chord of look-alikes with less evidence across it."""
    fragments, true, joins = ring
    plain = [join for join in joins if (join.second - join.first) in (1, COUNT - 1)]
    chord = Join(0, 4, Similarity(1.0, np.eye(3), np.zeros(3)), 4, 5, 40, 0.3, 0.02, np.zeros((1, 3)), 30, 0)

    found = align_fragments(fragments, [*plain, chord])

    assert [join for join, _ in found.dropped] == [chord]
    assert len(found.frames) == COUNT and off(found.frames, true)[0] < 2.0


def test_errors_around_loops_name_the_loop(ring):
    fragments, _, joins = ring
    plain = [join for join in joins if (join.second - join.first) in (1, COUNT - 1)]

    ((way, error),) = loop_errors(fragments, plain)

    assert sorted(way) == list(range(COUNT))
    assert 0.0 < error.off_deg < 3.0 and abs(error.scale) < 0.1 and 0.0 < error.shift < 0.5
    wrong = replace(plain[0], similarity=WRONG["scale"](plain[0].similarity), photos=1, explained=0)
    ((_, error),) = loop_errors(fragments, [wrong, *plain[1:]])
    assert error.scale == pytest.approx(np.log(1.6), abs=0.1)


def test_what_no_join_connects_has_no_frame(ring):
    fragments, _, joins = ring
    within = [join for join in joins if join.first >= 2 and join.second >= 2]

    found = align_fragments(fragments, within)

    assert sorted(found.frames) == [2, 3, 4, 5, 6, 7]
    assert sorted(align_fragments(fragments, []).frames) == [0]
