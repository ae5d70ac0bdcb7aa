"""Benchmarks of chapters 4 and 5, as far as they take no minutes, and the documents that all benchmarks write."""

import json
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest

from benchmarks.common.results import RESULTS, document, problems
from benchmarks.thesis.chapter4 import claims
from benchmarks.thesis.chapter5 import contests, setups, tables
from benchmarks.thesis.chapter5.bounds import full_bound, gap, reduced_bound
from benchmarks.thesis.chapter5.command import TEST_LIMITS, parse_test_limit
from benchmarks.thesis.chapter5.contests import (
    CAP_PERCENT,
    NON_ROBUST,
    PRODUCTION,
    Attempt,
    answered_K,
    e_center,
    e_focal,
    summary,
)
from benchmarks.thesis.chapter5.fits import Fit, fit_to_all, robust_fits, with_outlying_fits
from benchmarks.thesis.chapter5.lab import Lab
from benchmarks.thesis.chapter5.panels import Panel, minimum_x, panel_rows
from benchmarks.thesis.chapter5.sequences import (
    camera_matrix_from_projection,
    corner_sequence,
    fundamental_from_projections,
)
from benchmarks.thesis.chapter5.setups import Trial
from benchmarks.thesis.chapter5.slices import SCALES, focal_slice
from benchmarks.thesis.chapter5.sweep_claims import CurveClaim, check_levels
from sfm_app.camera.models import camera_matrix
from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.selfcal.thesis.constraint_forms import essential
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
from sfm_app.types import Calibration

K = camera_matrix(800.0, 900.0, 250.0, 200.0)


@pytest.fixture(scope="module")
def tracks():
    return make_tracks(TrackOptions(sigma_px=0.2), seed=0)


def test_a_projection_matrix_falls_apart_into_K_and_the_rest():
    R = axis_rotation(np.array([0.6, 0.0, 0.8]), 160.0)
    P = -3.0 * K @ np.column_stack([R, [0.3, -2.0, 5.0]])
    assert np.allclose(camera_matrix_from_projection(P), K)


def test_the_fundamental_matrix_of_two_cameras_joins_their_images():
    P1 = K @ np.eye(3, 4)
    P2 = K @ np.column_stack([axis_rotation(np.array([0.0, 1.0, 0.0]), 10.0), [1.0, 0.2, 0.1]])
    X = np.random.default_rng(0).uniform([-1, -1, 4, 1], [1, 1, 6, 1], (20, 4))
    x1, x2 = ((X @ P.T)[:, :2] / (X @ P.T)[:, 2:] for P in (P1, P2))
    assert sampson_distance(fundamental_from_projections(P1, P2), x1, x2).max() < 1e-9
    assert sampson_distance(fundamental_from_projections(P2, P1), x1, x2).max() > 1.0, "the direction matters"


def test_a_sequence_of_corners_has_the_pairs_that_share_enough(tmp_path, monkeypatch):
    folder = tmp_path / "vgg-corners" / "Merton-College-I"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(1)
    for view in range(3):
        np.savetxt(folder / f"{view + 1:03d}.corners", rng.uniform(0, 700, (40, 2)))
        pose = np.column_stack([axis_rotation(np.array([0.0, 1.0, 0.0]), 9.0 * view), [0.1 * view, 0, 0.0]])
        np.savetxt(folder / f"{view + 1:03d}.P", K @ pose)
    seen = [f"{k} {39 - k if k < 25 else '*'} {k if k < 12 else '*'}" for k in range(40)]
    (folder / "nview-corners").write_text("\n".join(seen) + "\n")

    found = corner_sequence(tmp_path, "Merton1")

    assert list(found.matches) == [(0, 1)] and found.matches[0, 1].shape == (25, 4), "12 corners make no pair"
    assert np.array_equal(found.matches[0, 1][3, 2:], np.loadtxt(folder / "002.corners")[36])
    assert np.allclose(found.K, K) and found.size == (1024, 768)
    assert found.first(2).matches.keys() == found.matches.keys() and not found.first(1).matches


def test_outliers_spoil_a_fit_to_all_and_no_robust_one(tracks):
    pair, share = (0, 1), {(0, 1): 0.3}
    spoilt = dict(setups.pair_matches(tracks, share, seed=2))
    exact = tracks.pairs[pair]

    def error(F):
        return sampson_distance(F, exact.exact_x1, exact.exact_x2).mean()

    clean = robust_fits(dict(setups.pair_matches(tracks)), seed=0)
    assert error(clean[pair].F) < 0.3 and error(robust_fits({pair: spoilt[pair]}, seed=0)[pair].F) < 0.3
    assert error(fit_to_all(spoilt[pair]).F) > 2.0 > 0.3 > error(fit_to_all(np.hstack([exact.x1, exact.x2])).F)
    mixed = with_outlying_fits(clean, {pair: spoilt[pair]})
    assert [name for name in mixed if mixed[name] is not clean[name]] == [pair]
    assert len(mixed[pair].matches) == 200 and list(mixed) == list(clean)


@pytest.mark.parametrize("experiment", [setups.matching_outliers, setups.outlying_matrices])
def test_a_seed_keeps_its_clean_matrices_over_all_levels(experiment):
    trials = list(experiment(3))
    first = trials[0]
    assert [trial.x for trial in trials] == sorted({trial.x for trial in trials})
    for trial in trials:
        same = [name for name in first.fits if trial.fits[name] is first.fits[name]]
        assert len(same) >= (8 if experiment is setups.matching_outliers else 10 - trial.x)
        assert np.array_equal(trial.K, first.K)


def test_errors_are_those_of_section_5_5_3():
    found = camera_matrix(880.0, 900.0, 200.0, 220.0)
    assert e_focal(found, K) == pytest.approx(5.0) and e_center(found, K) == pytest.approx(15.0)
    assert e_focal(K, K) == e_center(K, K) == 0.0


def calibration(method, identifiable, **evidence):
    return Calibration(np.eye(3), 10, 10, method, identifiable, evidence=evidence)


def test_doubt_is_an_answer_of_the_program_alone():
    told = {"fx_px": 1.0, "fy_px": 2.0, "cx_px": 3.0, "cy_px": 4.0}
    assert answered_K(PRODUCTION, calibration("guess", False, **told)) is None
    assert answered_K(NON_ROBUST, calibration("guess", False, **told)).tolist() == [[1, 0, 3], [0, 2, 4], [0, 0, 1]]
    assert answered_K(NON_ROBUST, calibration("guess", False)) is None
    assert answered_K(PRODUCTION, calibration(PRODUCTION, True, **told)).tolist() == np.eye(3).tolist()


def test_a_summary_says_how_many_answered_and_caps_the_rest():
    far = camera_matrix(9e6, 900.0, 250.0, 200.0)
    found = summary("m", 2.0, [Attempt("m", 2.0, A, K, ms) for A, ms in ((K, 1.0), (far, 3.0), (None, 8.0))])
    assert (found["tests"], found["answered"], found["ms"]) == (3, pytest.approx(2 / 3), 3.0)
    assert (found["e_focal"], found["e_focal median"], found["e_OC"]) == (CAP_PERCENT / 2, CAP_PERCENT / 2, 0.0)
    nothing = summary("m", 2.0, [Attempt("m", 2.0, None, K, 1.0)])
    assert nothing["answered"] == 0.0 and nothing["e_focal"] is None


def two_levels(seed, tracks):
    fits = {pair: Fit(view.F, np.hstack([view.x1, view.x2])) for pair, view in tracks.pairs.items()}
    for x in (0.0, 1.0):
        yield Trial(x + 0 * seed, fits, tracks.size, tracks.K[0])


@pytest.mark.parametrize(
    ("said", "own", "others", "expected"),
    [
        (CurveClaim("", "", "below", "a", ("b",)), [1, 5], [[2, 4]], [True, False]),
        (CurveClaim("", "", "below", "a", ("b", "c")), [1], [[2], [0.5]], [False]),
        (CurveClaim("", "", "below", "a", ("b",), limit=10), [1, 1], [[11, 9]], [True, False]),
        (CurveClaim("", "", "under", "a", limit=5), [4, 6, float("nan")], [], [True, False, False]),
        (CurveClaim("", "", "over", "a", limit=5), [4, 6], [], [False, True]),
        (CurveClaim("", "", "steady", "a"), [2, 4, 3], [], [True]),
        (CurveClaim("", "", "steady", "a"), [2, 4.1], [], [False]),
        (CurveClaim("", "", "rising", "a"), [2, 1, 5], [], [True]),
        (CurveClaim("", "", "falling", "a"), [2, 3], [], [False]),
    ],
)
def test_sentences_are_judged(said, own, others, expected):
    assert check_levels(said, own, others) == expected


def table_row(sequence, method, e, answered=1.0):
    given = {"e_focal": e, "e_OC": e, "e_focal median": e, "answered": answered, "method": method, "tests": 1}
    return {"sequence": sequence, **tables.with_printed_errors(sequence, given)}


def test_the_printed_means_are_those_of_the_thesis():
    rows = [table_row(name, method, 2.0) for name in tables.PRINTED_E_FOCAL for method in contests.METHODS]
    found = {row["method"]: row for row in tables.means(rows)}
    assert found[contests.ZERO_CURVES]["thesis"] == pytest.approx(15.82, abs=0.005)
    assert found["the best of the thesis's on each"]["thesis"] == pytest.approx(7.5, abs=0.005)
    assert found[PRODUCTION]["thesis"] is None and found[PRODUCTION]["here"] == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("e", "corridor", "answered", "verdicts"),
    [
        (2.9, 30.0, 1.0, ["holds", "holds"]),
        (3.1, 34.0, 1.0, ["does not hold"] * 2),
        (None, None, 0.0, ["does not hold", "holds"]),
    ],
)
def test_the_target_is_judged(e, corridor, answered, verdicts):
    rows = [table_row(name, PRODUCTION, e, answered) for name in tables.TARGET]
    rows.append(table_row("Corridor", PRODUCTION, corridor, answered))
    assert [claim.verdict for claim in tables.claims(rows) if claim.figure == "target"] == verdicts


def test_bounds_hold_and_the_reduced_one_ignores_the_error_of_F(tracks):
    F = tracks.F[0] / np.linalg.norm(tracks.F[0], ord=2)
    true_K, rng = tracks.K[0], np.random.default_rng(3)
    change = true_K @ np.diag([1.1, 1.1, 1.0]) - true_K
    noisy = F + 1e-4 * rng.normal(size=(3, 3))
    for rough in (F, noisy):
        assert float(gap(essential(rough, true_K + change))) <= full_bound(F, rough, true_K, change)
    assert reduced_bound(F, true_K, change) == pytest.approx(full_bound(F, F, true_K, change))
    assert reduced_bound(noisy, true_K, 0 * change) == 0.0 < full_bound(F, noisy, true_K, 0 * change)


def test_the_objective_of_exact_matrices_is_lowest_at_the_true_focal(tracks):
    panel = Panel("exact", tracks.K[0][0, 0] * SCALES, {"all": focal_slice(tracks.F, tracks.K[0])})
    assert minimum_x(panel, "all") == pytest.approx(tracks.K[0][0, 0])
    assert len(panel_rows([panel])) == len(SCALES)


def test_slow_methods_have_fewer_tests(tmp_path, tracks, monkeypatch):
    monkeypatch.setattr(setups, "two_levels", partial(two_levels, tracks=tracks), raising=False)
    setups.two_levels.__name__ = "two_levels"
    with ThreadPoolExecutor(1) as pool:
        lab = Lab(tmp_path, tmp_path, tmp_path, [NON_ROBUST, "kruppa"], 2, 1, {"kruppa": 1}, 0, pool)
        rows = lab.run_contest(setups.two_levels)
        assert lab.run_contest(setups.two_levels) is rows, "an experiment is run once"
    assert {row["method"]: row["tests"] for row in rows} == {NON_ROBUST: 2, "kruppa": 1}
    assert lab.test_limits_text == "at most 1 of `kruppa`"
    assert parse_test_limit("kruppa=3") == ("kruppa", 3) and dict(TEST_LIMITS).keys() <= set(contests.METHODS)


ROWS = [{"method": "a", "outliers": 0.1, "ms": 1.5}, {"method": "a", "outliers": 0.7, "ms": None}]


def test_a_document_says_all_that_is_promised():
    found = document("task", "about", {"seed": 0}, {"pairs": 2}, ROWS)
    assert problems(found) == []
    assert {"numpy", "numba", "pycolmap"} <= set(found["versions"])
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert problems(found | {"rows": []}) == ["there are no rows"]
    assert problems(found | {"rows": [{"ms": 1}]}) == ["row 0 names no method"]
    assert problems(found | {"rows": [{"method": "a", "ms": [1]}]}) == ["row 0 holds more than text and numbers"]
    assert sorted(problems(found | {"versions": None, "extra": 1})) == ["unknown key extra", "versions is not dict"]


def test_published_results_follow_the_schema():
    names = ("fundamental-*", "cameras*", "chapter?", "viewers", "corpus*", "trouble*")
    published = [path for name in names for path in RESULTS.glob(f"{name}.json")]
    assert {path.name: said for path in published if (said := problems(json.loads(path.read_text("utf-8"))))} == {}


def swept(**times):
    """Rows in which an estimator takes so many ms at 10 % and 70 %; its error is a tenth of that."""
    return [
        {"method": name, "outliers": level, claims.TIME: ms, claims.ERROR: ms / 10, claims.TRIALS: ms}
        for name, both in times.items()
        for level, ms in zip((0.1, 0.7), both, strict=True)
    ]


@pytest.mark.parametrize(
    ("ransac", "verdict"), [((10, 100), "holds"), ((2, 100), "holds in part"), ((2, 4), "does not hold")]
)
def test_a_claim_is_judged_level_by_level(ransac, verdict):
    rows = swept(**{"ransac": ransac, "lev-ransac-thesis": (2, 4)})
    found = {claim.says: claim for claim in claims.claims_of_sweep(rows)}
    assert found["LEV-RANSAC is over three times as fast as RANSAC"].verdict == verdict
    assert found["LEV-RANSAC is faster than all others"].verdict == "not measured"
    assert "msac" in found["LEV-RANSAC is faster than all others"].numbers


def test_matches_of_all_pairs_with_outliers_in_chosen_ones():
    tracks = make_tracks(TrackOptions(corrupted_pairs=3), seed=5)
    shares = {(0, 2): 0.25, (1, 4): 0.5}
    found = dict(setups.pair_matches(tracks, shares, reach_px=100.0, seed=1))
    again = dict(setups.pair_matches(tracks, {(0, 2): 0.25}, reach_px=100.0, seed=1))

    assert list(found) == list(tracks.pairs)
    for (i, j), matches in found.items():
        assert matches.shape == (200, 4) and np.array_equal(matches[:, :2], tracks.x[i])
        off = matches[:, 2:] - tracks.x[j]
        assert np.count_nonzero(off.any(axis=1)) == 200 * shares.get((i, j), 0) and np.abs(off).max() <= 100.0
    assert 52 < (found[1, 4][:, 2:] - tracks.x[4]).std() * 2**0.5 < 63, "uniform in +-100 has a deviation of 57.7"
    assert np.array_equal(found[0, 2], again[0, 2]), "a pair's outliers do not depend on the others"
