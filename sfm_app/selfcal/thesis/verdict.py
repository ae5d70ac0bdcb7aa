"""What all literal methods of the thesis share: the frame, and the verdict on the answer.

The verdict is not the thesis's: an answer counts as known where the pairs satisfy the constraint there, and do not
satisfy it as well at other focals.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sfm_app.camera.models import camera_matrix
from sfm_app.selfcal.consensus import CONSENSUS, Consensus, ambiguity_reason, best_rival, support_reason, votes
from sfm_app.selfcal.pairs import Pairs, guess_calibration, prepare
from sfm_app.types import Calibration, CameraPairs
from sfm_app.types.arrays import FloatArray

MIN_PAIRS = 3
"""Four unknowns and two constraints a pair; with two pairs nothing is left to contradict a wrong K. Counted, by
definition of the constraint (thesis 5.2.4)."""


class CameraParameters(NamedTuple):
    """The four parameters of K that the thesis seeks, in image widths from the top left corner."""

    fx: float
    fy: float
    u: float
    v: float

    @classmethod
    def initial(cls, tall: float) -> "CameraParameters":
        """Return K_init of thesis 5.7.2 for an image of width 1 and height `tall`.

        Its horizontal field of view is 53 degrees, not 90 as the thesis says.
        """
        return cls(1.0, 1.0, 0.5, 0.5 * tall)

    @property
    def K(self) -> FloatArray:
        """(3, 3) camera matrix."""
        return camera_matrix(*self)


Find = Callable[[Pairs, float, dict[str, float]], CameraParameters | str]
"""A method takes pairs in image widths, height over width, and a dict for its figures; it returns K, or why there is
none."""


def calibrate_with(method: str, pairs: CameraPairs, find: Find, sample: int = 0) -> Calibration:
    """Run a method and judge its answer.

    Args:
        sample: number of pairs that the method picks and fits alone. These agree even with a wrong answer, so that the
            others must confirm it.

    Returns:
        K with ``identifiable=True``, or a guess and the reason. In both cases `evidence` has the answer of the method:
        fx_px, fy_px, cx_px and cy_px.

    Raises:
        ValueError: malformed input, see `selfcal.pairs.prepare`.
    """
    width, height = size = pairs.size
    usable = prepare(pairs, unit_px=width, origin_px=(0.0, 0.0))
    evidence = {"pairs": float(len(usable))}
    if len(usable) < MIN_PAIRS:
        return guess_calibration(size, f"{len(usable)} usable pairs, {MIN_PAIRS} are needed", evidence)
    answer = find(usable, height / width, evidence)
    if isinstance(answer, str):
        return guess_calibration(size, answer, evidence)
    in_px = [float(width * value) for value in answer]
    evidence |= dict(zip(("fx_px", "fy_px", "cx_px", "cy_px"), in_px, strict=True))
    reason = _rejection_reason(answer, usable, sample, evidence)
    if reason:
        return guess_calibration(size, reason, evidence)
    return Calibration(camera_matrix(*in_px), width, height, method, identifiable=True, evidence=evidence)


def _rejection_reason(answer: CameraParameters, pairs: Pairs, sample: int, evidence: dict[str, float]) -> str:
    """Return why the answer is not trusted, or an empty string; add support and lead to the evidence."""
    theta = np.array([0.5 * np.log(answer.fx * answer.fy), answer.u, answer.v, np.log(answer.fy / answer.fx)])
    # the wider sigma: these answers are no maxima of the consensus, and may be off by a per cent
    consensus, sigmas = Consensus(pairs, np.inf), CONSENSUS.sigmas[:1]
    cast = votes(consensus, theta, sigmas[-1])
    margin = float(np.sum(cast)) - best_rival(consensus, theta, range(4), sigmas)
    evidence |= {"support": float(np.sum(cast) / np.sum(pairs.weights)), "lead": margin}
    if len(pairs) <= sample:
        return f"the answer fits {sample} pairs, and no other pairs confirm it"
    others = np.argsort(cast, kind="stable")[: len(pairs) - sample]
    return support_reason(cast[others], pairs.weights[others]) or ambiguity_reason(margin, cast)
