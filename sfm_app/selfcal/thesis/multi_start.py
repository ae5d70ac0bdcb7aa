"""Algorithm 2 of the thesis: least squares on random triples of pairs, from random cameras (5.6)."""

from functools import partial
from math import ceil, comb, log

import numpy as np

from sfm_app.selfcal.pairs import Pairs
from sfm_app.selfcal.thesis.constraint_forms import EQUATIONS, Equations, Halves
from sfm_app.selfcal.thesis.kruppa import pair_focals
from sfm_app.selfcal.thesis.least_squares import DEFAULT, find_minima
from sfm_app.selfcal.thesis.verdict import CameraParameters, calibrate_with
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs

METHOD = "multi-start"
SAMPLE = 3
"""Pairs in a minimal set: for four unknowns (thesis 5.6.3, Eq. 5.14)."""
CONFIDENCE = 0.95
"""Probability that any one triple is drawn (thesis 5.6.3)."""
MOST_STARTS = 4000
"""MaxIter grows with the cube of the number of pairs; from 22 pairs on this is the limit
(docs/algorithms/self-calibration.md); by hand."""
FOCAL_RANGE = (0.1, 3.0)
"""Focals that count, in image widths: thesis (5.29) ends at 3. The lower end was chosen by hand."""
USUAL_FOCAL = (1.0, 0.5)
"""Mean and standard deviation in image widths of the focal where no pair gives one. The mean is that of K_init (thesis
5.7.2); the deviation was chosen by hand."""


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Return the best of many least-squares solutions on three pairs each (thesis Algorithm 2)."""
    find = partial(algorithm_2, seed=seed, equations=EQUATIONS[options.constraint_form])
    return calibrate_with(METHOD, pairs, find, SAMPLE)


def algorithm_2(
    pairs: Pairs, tall: float, evidence: dict[str, float], seed: int, equations: Equations = DEFAULT
) -> CameraParameters:
    """Estimate the camera by Algorithm 2 as the thesis writes it, in image widths.

    Residual(s) is that of the triple: the thesis writes that other pairs play no part, and that this costs accuracy.
    Adds the distribution of the focal and MaxIter to the evidence.
    """
    rng = np.random.default_rng(seed)
    count = number_of_starts(len(pairs))
    mean, deviation = focal_distribution(pairs, tall)
    evidence |= {"starts": float(count), "focal_mean": mean, "focal_deviation": deviation}
    focal = np.clip(rng.normal(mean, deviation, count), *FOCAL_RANGE)
    center = rng.normal([0.5, 0.5 * tall], [1 / 6, tall / 6], (count, 2))
    starts = np.column_stack([focal, focal, center])
    # sorted by a value that depends on neither scale nor direction: the order of the pairs has no effect
    halves = Halves.from_fundamentals(pairs.F)[np.argsort(pairs.product, kind="stable")]
    triples = np.argsort(rng.random((count, len(pairs))), axis=1)[:, :SAMPLE]
    found = find_minima(halves[triples], np.ones(triples.shape), starts, equations)
    return CameraParameters(*(float(value) for value in found.cameras[np.argmin(found.sums)]))


def number_of_starts(pairs: int) -> int:
    """Return MaxIter of thesis 5.6.3: any one triple of the pairs is drawn with a probability of 0.95.

    N in its formula counts fundamental matrices ("every arrangement of three"), not frames as N in (5.14) does.
    """
    triples = comb(pairs, SAMPLE)
    return 1 if triples == 1 else min(MOST_STARTS, ceil(log(1 - CONFIDENCE) / log(1 - 1 / triples)))


def focal_distribution(pairs: Pairs, tall: float) -> tuple[float, float]:
    """Return thesis (5.12), (5.13): weighted mean and standard deviation of the pairs' own focals, in image widths."""
    focals = pair_focals(pairs, (0.5, 0.5 * tall))
    known = (focals > FOCAL_RANGE[0]) & (focals < FOCAL_RANGE[1])
    if not np.any(known):
        return USUAL_FOCAL
    mean = float(np.average(focals[known], weights=pairs.weights[known]))
    return mean, float(np.sqrt(np.average((focals[known] - mean) ** 2, weights=pairs.weights[known])))
