"""Claims of chapter 4 about its figures, and whether our own measurements confirm them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.common.results import Row
from benchmarks.thesis.claims import Claim, verdict

ERROR, TIME, TRIALS = "capped mean px", "ms mean", "trials mean"
LEV, RES, CLASSICS = "lev-ransac-thesis", "res-ransac", ("ransac", "msac", "mlesac")
ALL, LOW, HIGH = (0.0, 1.0), (0.0, 0.3), (0.6, 1.0)
"""Ranges of the outlier ratio that a claim covers."""
STEADY = 8.0
"""Time at 70 % outliers divided by that at 10 %, up to which we call it steady."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """The claim that one estimator has less error, time or trials than every other."""

    figure: str
    says: str
    winner: str
    others: Sequence[str]
    column: str
    ratios: tuple[float, float] = ALL
    factor: float = 1.0
    """Least ratio of the others' value to the winner's."""


def _verification_comparisons(figure: str, title: str, suffix: str) -> tuple[Comparison, ...]:
    plain, guided = f"ransac-{suffix}", f"lev-ransac-{suffix}"
    return (
        Comparison(f"{figure}a", f"the error with {title} is lower with LEV-RANSAC", guided, (plain,), ERROR),
        Comparison(f"{figure}b", f"plain {title} is faster at low ratios", plain, (guided,), TIME, LOW),
        Comparison(f"{figure}b", f"LEV-RANSAC with {title} is faster at high ratios", guided, (plain,), TIME, HIGH),
        Comparison(f"{figure}b", f"{title} makes LEV-RANSAC faster", guided, (LEV,), TIME),
    )


COMPARISONS = (
    Comparison("4.11a", "LEV-RANSAC's error is lower than RANSAC's, MSAC's and MLESAC's", LEV, CLASSICS, ERROR),
    Comparison("4.11a", "at high ratios RES-RANSAC's error is lower than LEV-RANSAC's", RES, (LEV,), ERROR, HIGH),
    Comparison("4.11b", "LEV-RANSAC is faster than all others", LEV, (*CLASSICS, RES), TIME),
    Comparison("4.11b", "LEV-RANSAC is over three times as fast as RANSAC", LEV, ("ransac",), TIME, factor=3.0),
    Comparison("4.11b", "the same in trials", LEV, ("ransac",), TRIALS, factor=3.0),
    Comparison("4.11b", "MLESAC takes much longer than RANSAC (here: twice)", "ransac", ("mlesac",), TIME, factor=2.0),
    Comparison("4.6", "RES-RANSAC's error is lower than RANSAC's, MSAC's and MLESAC's", RES, CLASSICS, ERROR),
    Comparison("4.6", "RES-RANSAC needs fewer trials than they do", RES, CLASSICS, TRIALS),
    *_verification_comparisons("4.12", "T(d,d)", "tdd"),
    *_verification_comparisons("4.13", "SPRT", "sprt"),
    Comparison(
        "4.4.4", "LEV-RANSAC with SPRT is the fastest of all", "lev-ransac-sprt",
        (*CLASSICS, RES, LEV, "ransac-tdd", "lev-ransac-tdd", "ransac-sprt"), TIME,
    ),
)  # fmt: skip
STEADINESS_CLAIMS = (
    ("4.11b", LEV, "ransac"),
    ("4.12b", "lev-ransac-tdd", "ransac-tdd"),
    ("4.13b", "lev-ransac-sprt", "ransac-sprt"),
)
"""Figure, the estimator that is steady over the ratios, and the one that is not."""
TRACED = (
    ("4.7", "the mean residual of inliers is below that of outliers", "residual mean", 1),
    ("4.7", "the residuals of inliers vary less than those of outliers", "residual std", 1),
    ("4.8", "the mean Cook's distance of inliers is below that of outliers", "cook mean", 1),
    ("4.9", "the mean prior of inliers is above that of outliers", "prior mean", -1),
)
"""Figure, claim, column, and 1 where inliers must have the smaller value, else -1."""


def claims_of_sweep(rows: Sequence[Row]) -> list[Claim]:
    """Judge the claims of Figures 4.11 to 4.13; `rows` has one row per estimator and level."""
    claims = [_judge_comparison(rows, comparison) for comparison in COMPARISONS]
    return sorted(
        claims + [_judge_steadiness(rows, *names) for names in STEADINESS_CLAIMS], key=lambda claim: claim.figure
    )


def claims_of_traces(traces: Mapping[str, Sequence[Row]], figures: Sequence[str]) -> list[Claim]:
    """Judge the claims of Figures 4.7 to 4.9; `traces` holds, per sequence, one row for every best model."""
    found = []
    for figure, says, column, sign in (entry for entry in TRACED if entry[0] in figures):
        holds, numbers = [], []
        for name, rows in traces.items():
            inside, outside = ([row[f"{who} {column}"] for row in rows] for who in ("inliers", "outliers"))
            right = [sign * a < sign * b for a, b in zip(inside, outside, strict=True)]
            holds += right
            last = f"{inside[-1]:.3g} against {outside[-1]:.3g} at the last"
            numbers.append(f"{name}: at {sum(right)} of {len(right)} best models, {last}")
        found.append(Claim(figure, says, verdict(holds), "; ".join(numbers)))
    return found


def claim_of_refits(rows: Sequence[Row]) -> Claim:
    """Judge the claim of Figure 4.4; `rows` has one row per sample."""
    minimal, linear = (np.array([row[name] for row in rows]) for name in ("7-point", "8-point refit"))
    medians = f"median {np.median(linear):.3g} against {np.median(minimal):.3g} px"
    numbers = f"lower in {np.mean(linear < minimal):.0%} of {len(rows)} samples, {medians}"
    return Claim("4.4", "refitting to the inliers lowers the residuals", verdict(list(linear < minimal)), numbers)


def curve(rows: Sequence[Row], method: str, column: str) -> dict[float, float]:
    """Return a column of one estimator by outlier ratio; empty where it was not measured."""
    return {row["outliers"]: row[column] for row in rows if row["method"] == method}


def _judge_comparison(rows: Sequence[Row], claim: Comparison) -> Claim:
    curves = {name: curve(rows, name, claim.column) for name in (claim.winner, *claim.others)}
    missing = [name for name, found in curves.items() if not found]
    low, high = claim.ratios
    levels = [level for level in curves[claim.winner] if low <= level <= high]
    if missing or not levels:
        return Claim(claim.figure, claim.says, "not measured", f"missing: {', '.join(missing) or 'such ratios'}")
    best = {level: min(curves[name][level] for name in claim.others) for level in levels}
    times = {level: best[level] / max(curves[claim.winner][level], 1e-9) for level in levels}
    what = {ERROR: "error", TIME: "time", TRIALS: "trials"}[claim.column]
    rival = "the best other one" if len(claim.others) > 1 else claim.others[0]
    listed = ", ".join(f"{100 * level:.0f} %: {value:.2f}" for level, value in times.items())
    holds = [value > claim.factor for value in times.values()]
    return Claim(claim.figure, claim.says, verdict(holds), f"{what} of {rival} : {claim.winner} at {listed}")


def _judge_steadiness(rows: Sequence[Row], figure: str, steady: str, other: str) -> Claim:
    says = f"the time of {steady} is steady over the ratios, that of {other} degrades"
    curves = {name: curve(rows, name, TIME) for name in (steady, other)}
    if not all({0.1, 0.7} <= set(found) for found in curves.values()):
        return Claim(figure, says, "not measured", "needs both estimators at 10 % and 70 %")
    growth = {name: found[0.7] / found[0.1] for name, found in curves.items()}
    holds = [growth[steady] <= STEADY, growth[other] > 2 * growth[steady]]
    listed = ", ".join(f"{name} {value:.1f}" for name, value in growth.items())
    return Claim(figure, says, verdict(holds), f"time at 70 % : 10 %: {listed}; steady is up to {STEADY:g}")
