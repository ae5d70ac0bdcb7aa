"""Tests of hypotheses: what they let through, and what they cost."""

import numpy as np
import pytest

from sfm_app.ransac.verification import BLOCK, bail_out_table


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_bail_out_rarely_drops_an_equal_model_and_mostly_a_bad_one(share):
    rng, count = np.random.default_rng(1), 2000
    table = bail_out_table(count, share)

    def survives(real_share):
        inlier = rng.permutation(count) < round(real_share * count)
        seen = np.cumsum(inlier)[BLOCK - 1 : -1 : BLOCK][: len(table)]
        return (seen >= table).all()

    assert np.mean([survives(share) for _ in range(300)]) > 0.97
    assert np.mean([survives(share / 2) for _ in range(300)]) < 0.1


def test_bail_out_table_of_few_matches_is_empty():
    assert len(bail_out_table(BLOCK, 0.5)) == 0
    assert bail_out_table(1, 1.0).tolist() == []
    assert bail_out_table(4 * BLOCK, 1.0).tolist() == [BLOCK, 2 * BLOCK, 3 * BLOCK]
