"""What a bundle says about its cameras, on bundles whose poses and points are the true ones."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.bundle.lens_evidence import divide_by_focal, estimate_lenses
from sfm_app.bundle.lens_parts import PERSPECTIVE_PARTS, CameraRule, LensPriors
from sfm_app.bundle.normal_equations import Bundle, bundle_scale, project, reduce
from sfm_app.camera.rows import CAMERA, PERSPECTIVE
from sfm_app.types import CameraPrior

SIZE = np.array([1000.0, 800.0])
PLAIN = (900.0, 900.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0)
NAMES = [part.name for part in PERSPECTIVE_PARTS]


def padded(*params):
    """Cameras of eight parameters, with zeros for the others."""
    return np.array([[*row, *[0.0] * (CAMERA - len(row))] for row in params])


def seen(*true, photos=8, noise_px=0.3, seed=0, points=600):
    """Photos of a box of points from all around, some of each camera; as measured through the true cameras."""
    rng = np.random.default_rng(seed)
    depth = 3.0 * true[0][0] / 900.0
    X = rng.uniform(-1, 1, (points, 3))
    R = np.array([turn(0.3 * k - 1.0, 0.2 * (-1) ** k, 0.5 * k) for k in range(photos * len(true))])
    t = np.tile([0.0, 0.0, depth], (len(R), 1)) + rng.uniform(-0.1, 0.1, (len(R), 3))
    photo, point = (index.ravel() for index in np.meshgrid(range(len(R)), range(points), indexing="ij"))
    camera = np.repeat(np.arange(len(true)), photos)
    family = np.full(len(true), PERSPECTIVE)
    bundle = Bundle(padded(*true), camera, R, t, X, photo, point, np.zeros((len(photo), 2)), family)
    x = project(bundle)[0]
    inside = np.all((x > 0) & (x < SIZE), axis=1)
    kept = np.bincount(point[inside], minlength=points) > 2
    inside &= kept[point]
    x += rng.normal(scale=noise_px, size=x.shape)
    places = (np.cumsum(kept) - 1)[point[inside]]
    return replace(bundle, X=X[kept], photo=photo[inside], point=places, x=x[inside])


def turn(pan, tilt, roll):
    (a, b, c), (p, q, r) = np.cos([pan, tilt, roll]), np.sin([pan, tilt, roll])
    about_z, about_x = [[c, -r, 0], [r, c, 0], [0, 0, 1]], [[1, 0, 0], [0, b, -q], [0, q, b]]
    return np.array(about_z) @ np.array(about_x) @ np.array([[a, 0, p], [0, 1, 0], [-p, 0, a]])


def starting_at(bundle, *params):
    return replace(bundle, params=padded(*params))


def asked(bundle, *cameras, rules=()):
    """All about some cameras, of others only focal and k1."""
    always = np.array([name in ("focal", "k1") for name in NAMES])
    rows = np.array([always | bool(all_of) for all_of in cameras])
    return LensPriors.from_cameras(bundle.params, bundle.family, np.tile(SIZE, (len(rows), 1)), rows, rules)


def answer(bundle, *cameras, claim=None):
    cameras = cameras or (True,) * len(bundle.params)
    rules = [CameraRule(prior=claim)] * len(cameras)
    return estimate_lenses(bundle.params, reduce(bundle, bundle_scale(bundle)), asked(bundle, *cameras, rules=rules))


def freed(found, camera=0):
    return {name for name, on in zip(NAMES, found.free[camera], strict=True) if on}


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({}, set()),
        ({2: 620.0}, {"center"}),
        ({1: 1150.0}, {"aspect"}),
        ({4: -0.1}, {"k1"}),
        ({4: -0.2, 5: 0.2}, {"k1", "k2"}),
        ({6: 0.004, 7: -0.003}, {"p1 p2"}),
    ],
)
def test_a_part_is_freed_where_the_photos_ask_for_it(change, parts):
    true = list(PLAIN)
    for place, value in change.items():
        true[place] = value
    found = answer(seen(true))
    assert freed(found) == parts and np.all(np.abs(found.params[0, :8] - true) < 3 * found.deviations[0, :8])


def test_one_step_finds_a_camera_that_is_a_little_off():
    true = [900.0, 900.0, 505.0, 396.0, -0.1, 0.0, 0.0, 0.0]
    bundle = starting_at(seen(true), [894.0, 894.0, 490.0, 404.0, -0.09, 0.0, 0.0, 0.0])
    found = answer(bundle)
    assert found.params[0, :8] == pytest.approx(true, abs=1.5)
    assert found.params[0, 4] == pytest.approx(-0.1, abs=0.004) and found.step > 1
    assert answer(starting_at(bundle, found.params[0])).step < found.step / 3


def test_stated_deviations_are_those_of_independent_noise_times_the_misfit():
    true = [900.0, 900.0, 540.0, 390.0, 0.0, 0.0, 0.0, 0.0]
    found = [answer(seen(true, seed=seed, photos=5, points=200)) for seed in range(40)]
    scatter = np.std([one.params[0, :4] for one in found], axis=0)
    stated = np.mean([one.deviations[0, :4] for one in found], axis=0)
    assert np.all((stated > 1.5 * scatter) & (stated < 8 * scatter))


def test_parameters_are_off_together_as_their_mean_squares_say():
    true, places = [900.0, 900.0, 500.0, 400.0, -0.2, 0.2, 0.0, 0.0], [0, 4, 5]
    found = [answer(seen(true, seed=seed, photos=5, points=200)) for seed in range(20)]
    drawn = np.corrcoef(np.array([one.params[0, places] for one in found]).T)
    squares = np.mean([one.mean_squares[0] for one in found], axis=0)[np.ix_(places, places)]
    stated = squares / np.sqrt(np.outer(np.diag(squares), np.diag(squares)))
    assert -1.0 < stated[1, 2] < -0.7 and -1.0 < drawn[1, 2] < -0.7  # what k1 bends, k2 bends back
    assert np.abs(stated - drawn)[0].max() < 0.5


def test_what_is_not_determined_stays_where_it_is_and_may_be_off():
    true = [30000.0, 30000.0, 506.0, 395.0, 0.0, 0.0, 0.0, 0.0]
    bundle = starting_at(seen(true, noise_px=1.0), [30000.0, 30000.0, 498.0, 401.0, 0.0, 0.0, 0.0, 0.0])
    found = answer(bundle)
    assert found.params[0, 2:4].tolist() == [498.0, 401.0] and not found.determined[0, NAMES.index("center")]
    # three photo sets of ten are cropped, by 15 % of the longer side; whether this one is, rounding may say a little
    # about: with eight seeds the deviations were between 40 and 150 pixels
    assert (found.deviations[0, 2:4] > 3.0 * np.abs(found.params[0, 2:4] - true[2:4])).all()
    assert (found.deviations[0, 2:4] < 1.01 * 150).all()


def test_photos_that_pull_in_different_directions_widen_the_deviations():
    true = list(PLAIN)
    stated = []
    for zoom in (0.0, 0.05):
        focals = [900.0 * (1 + zoom * (-1) ** k) for k in range(8)]
        bundle = seen(*([focal, focal, *true[2:]] for focal in focals), photos=1)
        one = replace(bundle, params=padded(true), family=bundle.family[:1], camera=np.zeros_like(bundle.camera))
        stated.append(answer(one).deviations[0, 0] / 900.0)
    assert stated[0] < 0.004 and 0.01 < stated[1] < 0.1


def test_what_photos_ask_of_the_cameras_adds_up():
    found = reduce(starting_at(seen(PLAIN), [905.0, 899.0, 503.0, 400.0, 0.01, 0.0, 0.0, 0.0]), 1.0)
    assert found.scores.shape == (8, CAMERA)
    assert found.scores.sum(axis=0) == pytest.approx(found.g, rel=1e-6, abs=1e-6 * np.abs(found.g).max())


def test_a_camera_of_few_photos_is_asked_for_focal_and_k1_only():
    other = [700.0, 700.0, 620.0, 400.0, -0.1, 0.0, 0.0, 0.0]
    bundle = seen(list(PLAIN), other, photos=5)
    bundle = starting_at(bundle, list(PLAIN), [702.0, 702.0, 500.0, 400.0, -0.1, 0.0, 0.0, 0.0])
    found = answer(bundle, True, False)
    assert found.params[1, 2:4].tolist() == [500.0, 400.0] and not found.params[1, 5:].any()
    assert freed(found, 1) <= {"k1"}


@pytest.mark.parametrize("off", [-2.0, 30.0])
def test_a_camera_that_runs_away_stays_and_is_not_determined(off):
    bundle = seen(list(PLAIN))
    start = padded(PLAIN)
    reduced = reduce(bundle, 1.0)
    far = replace(reduced, g=reduced.H @ (900.0 * (off - 1.0) * np.eye(CAMERA)[:2].sum(axis=0)))
    held, found = estimate_lenses(start, far, asked(bundle, True)), estimate_lenses(start, reduced, asked(bundle, True))
    assert held.held.tolist() == [True] and found.held.tolist() == [False]
    assert np.array_equal(held.params, start) and not held.determined.any() and held.step == 0
    assert np.all(held.deviations[0, :2] >= 0.7 * 900) and np.isfinite(held.deviations).all()
    assert np.all(held.deviations[0, 2:4] >= 0.15 * 1000)


def test_a_bundle_that_says_nothing_leaves_cameras_as_unsure_as_they_were_before():
    bundle = seen(list(PLAIN), photos=1, points=3)
    found = answer(bundle)
    assert found.params[0, :8] == pytest.approx(PLAIN, abs=1)
    assert 0.5 * 900 < found.deviations[0, 0] < 1.5 * 900 and not found.determined.any()


@pytest.mark.parametrize(("factor", "contradicted"), [(1.0, False), (1.03, False), (0.8, True), (1.2, True)])
def test_photos_outweigh_a_claimed_focal(factor, contradicted):
    bundle = seen(list(PLAIN))
    plain, found = answer(bundle), answer(bundle, claim=CameraPrior("a net", 900.0 * factor, 45.0 * factor))
    assert freed(plain) == set() and freed(found) == ({"focal"} if contradicted else set())
    assert abs(found.params[0, 0] - plain.params[0, 0]) < 0.2 * plain.deviations[0, 0]
    assert found.deviations[0, 0] == pytest.approx(plain.deviations[0, 0], rel=0.1)


def test_a_claim_determines_what_the_photos_leave_open():
    true = [30000.0, 30000.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0]
    bundle = starting_at(seen(true, noise_px=1.0, points=100), [27000.0, 27000.0, *true[2:]])
    claim = CameraPrior("a net", 30300.0, 300.0)
    plain, found = answer(bundle), answer(bundle, claim=claim)
    assert plain.deviations[0, 0] > 1500
    assert found.params[0, :2] == pytest.approx([30300.0] * 2, abs=150)
    assert 250 < found.deviations[0, 0] < 0.6 * plain.deviations[0, 0]


# Photos of other cameras.


def as_one_camera(bundle, *params):
    return replace(bundle, params=padded(params), camera=0 * bundle.camera, family=bundle.family[:1])


def with_focal(factor, lens=()):
    true = [900.0 * factor, 900.0 * factor, *PLAIN[2:]]
    for place, value in dict(lens).items():
        true[place] = value
    return true


@pytest.mark.parametrize("lens", [{}, {2: 560.0}, {4: -0.1}])
def test_photos_of_two_cameras_of_one_size_are_told_apart_even_if_their_lens_is_not_known_yet(lens):
    near, far = with_focal(0.95, lens), with_focal(1.05, lens)
    bundle = as_one_camera(seen(near, far, near, far, photos=2), *PLAIN)
    first, second = divide_by_focal(bundle, asked(bundle, True)).reshape(2, 2, 2).transpose(1, 0, 2)
    assert len(np.unique(first)) == len(np.unique(second)) == 1 and first[0, 0] != second[0, 0]


@pytest.mark.parametrize(("span", "noise_px", "points"), [(0.3, 0.3, 600), (0.16, 2.0, 80)])
def test_photos_of_a_zoom_get_a_camera_each(span, noise_px, points):
    cameras = map(with_focal, np.linspace(1 - span / 2, 1 + span / 2, 8))
    bundle = as_one_camera(seen(*cameras, photos=1, noise_px=noise_px, points=points), *PLAIN)
    assert sorted(divide_by_focal(bundle, asked(bundle, True))) == list(range(8))


@pytest.mark.parametrize("lens", [{}, {2: 540.0}, {4: -0.05}, {1: 950.0}])
@pytest.mark.parametrize("noise_px", [0.3, 20.0])
def test_photos_of_one_camera_stay_together_even_if_its_lens_is_not_known_yet(lens, noise_px):
    bundle = as_one_camera(seen(with_focal(1.0, lens), noise_px=noise_px, points=600 if noise_px < 1 else 30), *PLAIN)
    assert not divide_by_focal(bundle, asked(bundle, True)).any()


def test_a_difference_as_by_focusing_divides_no_camera():
    bundle = as_one_camera(seen(with_focal(0.985), with_focal(1.015), photos=4), *PLAIN)
    assert not divide_by_focal(bundle, asked(bundle, True)).any()


def test_only_the_camera_that_does_not_fit_is_divided():
    bundle = seen(with_focal(0.9), with_focal(1.1), list(PLAIN), photos=4)
    bundle = replace(bundle, params=padded(PLAIN, PLAIN), camera=bundle.camera // 2, family=bundle.family[:2])
    numbers = divide_by_focal(bundle, asked(bundle, True, True))
    assert len(set(numbers[:4])) == len(set(numbers[4:8])) == 1 and numbers[0] != numbers[4]
    assert numbers[8:].tolist() == [1] * 4
