import numpy as np

from sfm_app.selfcal.consensus import objection


def objected(theta, spread=0.001):
    return objection(np.array(theta), spread, (0.5, 0.375))


def test_what_the_pairs_agree_on_can_still_be_wrong():
    assert objected([0.0, 0.49, -0.37, 0.0]) == ""
    assert objected([0.0, 0.0, 0.0, 0.0], spread=0.09) == ""
    assert "uncertain by 12 %" in objected([0.0, 0.0, 0.0, 0.0], spread=0.12)
    assert "end of the range" in objected([np.log(0.3), 0.0, 0.0, 0.0])
    assert "end of the range" in objected([np.log(5.1), 0.0, 0.0, 0.0])
    assert "center" in objected([0.0, 0.51, 0.0, 0.0])
    assert "center" in objected([0.0, 0.0, -0.38, 0.0])
