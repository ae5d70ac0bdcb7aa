"""A few bundles of `benchmarks.lenses.models`: the right camera model is chosen, and the lens is accurate."""

import numpy as np
import pytest

from benchmarks.lenses.models import STRONG, fisheye_case, measure, perspective_case, summarize

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", [0, 1, 2, 5])
def test_the_model_of_a_perspective_lens_is_found(seed):
    row = measure("plain", seed, hold_out=False)

    assert row["right"] == 1 and row["needless"] == 0 and row["file"] == "OPENCV"
    assert 0.0 < row["focal %"] < 0.1 and row["lost"] > 0.0


@pytest.mark.parametrize("seed", [0, 4, 8])
def test_a_fisheye_stays_one_and_its_radius_is_accurate(seed):
    row = measure("fisheye", seed, hold_out=False)

    assert row["file"] == "OPENCV_FISHEYE" and "prism" not in row["free"]
    assert 0.0 < row["radius %"] < 0.1


def test_no_other_model_explains_held_out_observations_clearly_better():
    row = measure("plain", 2, hold_out=True)

    assert row["chosen"] == "RADIAL" and 0.0 <= row["below"] < np.log(STRONG)


def test_cases_are_the_same_each_time_and_differ_from_seed_to_seed():
    first, again, other = (perspective_case("plain", seed) for seed in (3, 3, 4))

    assert (first.drawn.X == again.drawn.X).all() and first.start.params.tolist() == again.start.params.tolist()
    assert not (first.drawn.X == other.drawn.X).all()
    assert {fisheye_case("fisheye", seed).lens.split()[0] for seed in (0, 3, 6)} == {
        "equidistant", "equisolid", "stereographic"
    }  # fmt: skip


def test_the_summary_counts_bundles_by_lens():
    rows = [
        {"group": "plain", "lens": lens, "right": right, "needless": 2 - right, "focal %": 0.1 * right, "radius %": 0.2,
         "file": "OPENCV", "below": 1.0 - right}
        for lens, right in (("k1", 1), ("k1", 0), ("k1 k2", 1))
    ]  # fmt: skip

    every, one, two = summarize(rows)

    assert (every["lens"], every["bundles"], every["right %"], every["most needless"]) == ("all", 3, 66.7, 2)
    assert (one["lens"], one["right %"], two["right %"]) == ("k1", 50.0, 100.0)
    assert every["held-out %"] == 100.0
