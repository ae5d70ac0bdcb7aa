import json
import sys

import numpy as np
import pytest

from benchmarks.common.results import RESULTS, document, pivot, problems, table
from benchmarks.thesis.chapter4 import claims
from benchmarks.thesis.corners import load_corners, with_outliers

ROWS = [{"method": "a", "outliers": 0.1, "ms": 1.5}, {"method": "a", "outliers": 0.7, "ms": None}]


def test_a_document_says_all_that_is_promised():
    found = document("task", "about", {"seed": 0}, {"pairs": 2}, ROWS)

    assert problems(found) == []
    assert {"numpy", "numba", "pycolmap"} <= set(found["versions"])
    assert json.loads(json.dumps(found, allow_nan=False)) == found


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"rows": []}, "there are no rows"),
        ({"rows": [{"ms": 1}]}, "row 0 names no method"),
        ({"rows": [{"method": "a", "ms": [1]}]}, "row 0 holds more than text and numbers"),
        ({"versions": None}, "versions is not dict"),
        ({"extra": 1}, "unknown key extra"),
    ],
)
def test_a_wrong_document_is_told(change, problem):
    assert problems(document("task", "about", {}, {}, ROWS) | change) == [problem]


def test_published_results_follow_the_schema():
    names = ("fundamental-*", "cameras*", "chapter?", "viewers", "corpus*", "trouble*")
    published = [path for name in names for path in RESULTS.glob(f"{name}.json")]

    assert {path.name: problems(json.loads(path.read_text("utf-8"))) for path in published} == {
        path.name: [] for path in published
    }


def test_tables():
    assert pivot(ROWS, "outliers", "ms") == [{"method": "a", "0.1": 1.5, "0.7": None}]
    assert table(ROWS, ["method", "ms"]) == "| method | ms |\n|---|---|\n| a | 1.5 |\n| a |  |\n"


def test_a_missing_package_is_named_with_the_way_to_get_it(monkeypatch):
    from benchmarks.fundamental import methods
    from sfm_app.settings import EpipolarSettings

    monkeypatch.setitem(sys.modules, "poselib", None)
    with pytest.raises(SystemExit, match=r"poselib is missing: pip install -e '\.\[bench\]'"):
        methods.rivals(["PoseLib"], EpipolarSettings())


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


def test_steady_means_hardly_growing_while_the_other_does():
    def verdict(lev, ransac):
        rows = swept(**{"ransac": ransac, "lev-ransac-thesis": lev})
        return next(c.verdict for c in claims.claims_of_sweep(rows) if "is steady" in c.says)

    assert verdict((2, 4), (2, 400)) == "holds"
    assert verdict((2, 4), (2, 6)) == "holds in part"
    assert verdict((2, 40), (2, 60)) == "does not hold"


def test_corners_are_paired_by_the_points_they_show(tmp_path):
    (tmp_path / "001.corners").write_text("1 2\n3 4\n5 6\n")
    (tmp_path / "002.corners").write_text("10 20\n30 40\n")
    (tmp_path / "nview-corners").write_text("2 0 *\n0 * 1\n* 1 1\n1 1 *\n")

    x1, x2 = load_corners(tmp_path, 1, 2)

    assert x1.tolist() == [[5, 6], [3, 4]] and x2.tolist() == [[10, 20], [30, 40]]


def test_artificial_outliers_are_as_many_as_asked():
    x2 = np.zeros((200, 2))
    moved, is_inlier = with_outliers(x2, 0.3, 50.0, seed=1)

    assert np.count_nonzero(~is_inlier) == 60
    assert np.array_equal(np.any(moved != 0, axis=1), ~is_inlier)
    assert 40 < np.abs(moved).max() <= 50 and not x2.any()
