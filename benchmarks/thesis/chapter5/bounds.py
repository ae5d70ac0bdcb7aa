"""Bounds from perturbation theory for one fundamental matrix (Figures 5.7 to 5.9)."""

import numpy as np

from benchmarks.common.figures import label, pyplot
from benchmarks.thesis.chapter5.fits import FloatArray, fit_to_all
from benchmarks.thesis.chapter5.lab import FigureResult, Lab
from benchmarks.thesis.chapter5.panels import Panel, draw, panel_rows
from benchmarks.thesis.chapter5.sequences import ImageSequence
from benchmarks.thesis.chapter5.setups import REACH_PX
from benchmarks.thesis.claims import Claim, verdict
from benchmarks.thesis.corners import with_outliers
from sfm_app.selfcal.thesis.constraint_forms import essential
from sfm_app.selfcal.thesis.perturbation import error_discrepancies

FOCAL_ERRORS = np.linspace(-0.3, 0.3, 120)
"""Relative errors of the focal, without 0, where all curves but the bound of a noisy F vanish."""
OUTLIER_SHARE = 0.1
"""Share of outliers in a noisy F."""
OUTLYING = 3
FOCAL_OFF = 0.1


def gap(E: FloatArray) -> FloatArray:
    """Compute s1 - s2 (...,) of E (..., 3, 3)."""
    s = np.linalg.svd(E, compute_uv=False)
    return np.asarray(s[..., 0] - s[..., 1])


def full_bound(F: FloatArray, noisy: FloatArray, K: FloatArray, change: FloatArray) -> float:
    """Compute 2 |error of E| of thesis (5.19), (5.21), which assumes that the true F is known; F's and K's (3, 3)."""
    error = essential(noisy, K + change) - essential(F, K)
    return 2.0 * float(np.linalg.norm(error, ord=2))


def reduced_bound(noisy: FloatArray, K: FloatArray, change: FloatArray) -> float:
    """Compute 2 |part of E's error that K alone causes| of thesis (5.22), with its transposes corrected."""
    return 2.0 * float(np.linalg.norm(essential(noisy, K + change) - essential(noisy, K), ord=2))


def draw_bounds(lab: Lab) -> FigureResult:
    """Draw Figures 5.7 and 5.8: objective, bound and reduced bound over the error of the focal."""
    panels = []
    for name in ("Merton1", "Wadham"):
        sequence = lab.sequence(name)
        pair, F = next(iter(sequence.Fs.items()))
        F = _with_common_camera(F, sequence.Ks[pair[0]], sequence.Ks[pair[1]], sequence.K)
        for title, rough in (("exact F", F), ("noisy F", _noisy_fundamental(sequence, pair, F, lab.seed))):
            panels.append(Panel(f"{name}, {title}", 100 * FOCAL_ERRORS, _bounds(F, rough, sequence.K)))
    figure = draw(panels, "error of the focal, %", "s1 - s2", log=True, columns=2)
    lab.keep("5.7-5.8", figure, panel_rows(panels))
    return FigureResult([_claim_of_bound(panels), _claim_of_reduced(panels)], note=_BOUND_NOTE)


def draw_discrepancies(lab: Lab) -> FigureResult:
    """Draw Figure 5.9: Error Discrepancy of ten F's, the first three outlying, at a focal that is 10 % off."""
    figure, axes = pyplot().subplots(1, 2, figsize=(8.6, 3.2))
    rows, holds, numbers = [], [], []
    for axis, name in zip(axes, ("Corridor", "Wadham"), strict=True):
        sequence = lab.sequence(name).first(5)
        ED = np.array([_discrepancies(sequence, seed) for seed in range(lab.tests)])
        shown = ED[0]
        axis.set_xscale("log")
        axis.barh(range(1, len(shown) + 1), shown, color=["C3"] * OUTLYING + ["C0"] * (len(shown) - OUTLYING))
        label(axis, "Error Discrepancy (5.23)", "number of F", f"{name}; red: 10 % outliers")
        axis.invert_yaxis()
        axis.set_yticks(range(1, len(shown) + 1))
        axis.grid(axis="y", visible=False)
        rows += [
            {"panel": name, "F": k + 1, "outlying": int(k < OUTLYING), "ED": float(v)} for k, v in enumerate(shown)
        ]
        apart = float(np.mean(ED[:, :OUTLYING].min(axis=1) > ED[:, OUTLYING:].max(axis=1)))
        holds.append(apart > 0.5)
        medians = f"{np.median(ED[:, :OUTLYING]):.2g} against {np.median(ED[:, OUTLYING:]):.2g}"
        numbers.append(f"{name}: median {medians}; all three above all others in {apart:.0%} of {len(ED)} draws")
    lab.keep("5.9", figure, rows)
    says = "the Error Discrepancy of outlying F's is significantly higher"
    return FigureResult([Claim("5.9", says, verdict(holds), "; ".join(numbers))])


_BOUND_NOTE = (
    "First pair of each sequence; F from the true cameras, both with the K of the first view, and scaled to |F| = 1. "
    "The noisy F is fitted to all corners, of which 10 % are moved by up to 256 px, and scaled and signed alike. A "
    "mere change of the focal stretches E far more than it parts s1 from s2, so that either bound is loose."
)


def _bounds(F: FloatArray, noisy: FloatArray, K: FloatArray) -> dict[str, FloatArray]:
    changes = [K @ np.diag([1.0 + off, 1.0 + off, 1.0]) - K for off in FOCAL_ERRORS]
    return {
        "objective": np.array([float(gap(essential(noisy, K + change))) for change in changes]),
        "bound (5.21)": np.array([full_bound(F, noisy, K, change) for change in changes]),
        "reduced bound (5.22)": np.array([reduced_bound(noisy, K, change) for change in changes]),
    }


def _claim_of_bound(panels: list[Panel]) -> Claim:
    above = [np.array(p.lines["objective"]) <= np.array(p.lines["bound (5.21)"]) for p in panels]
    numbers = ", ".join(f"{p.title}: at {np.mean(a):.0%}" for p, a in zip(panels, above, strict=True))
    return Claim("5.7", "the objective stays below its bound", verdict([bool(a.all()) for a in above]), numbers)


def _claim_of_reduced(panels: list[Panel]) -> Claim:
    shares = {
        p.title: float(np.mean(np.array(p.lines["objective"]) <= np.array(p.lines["reduced bound (5.22)"])))
        for p in panels
    }
    holds = [share > 0.9 if "exact" in name else share < 0.5 for name, share in shares.items()]
    says = "the reduced bound lies above the objective of exact F's, and mostly below that of noisy ones"
    return Claim(
        "5.8", says, verdict(holds), ", ".join(f"{name}: above at {share:.0%}" for name, share in shares.items())
    )


def _with_common_camera(F: FloatArray, K1: FloatArray, K2: FloatArray, K: FloatArray) -> FloatArray:
    """Return F as if both views had the camera matrix K; largest singular value 1."""
    back = np.linalg.inv(K)
    same = back.T @ K2.T @ F @ K1 @ back
    return np.asarray(same / np.linalg.norm(same, ord=2))


def _noisy_fundamental(sequence: ImageSequence, pair: tuple[int, int], F: FloatArray, seed: int) -> FloatArray:
    found = _outlying_fundamental(sequence.matches[pair], seed)
    found = found / np.linalg.norm(found, ord=2)
    return np.asarray(found if np.sum(found * F) > 0 else -found)


def _outlying_fundamental(rows: FloatArray, seed: int) -> FloatArray:
    moved, _ = with_outliers(rows[:, 2:], OUTLIER_SHARE, REACH_PX, seed)
    return fit_to_all(np.column_stack([rows[:, :2], moved])).F


def _discrepancies(sequence: ImageSequence, seed: int) -> FloatArray:
    Fs = [
        _outlying_fundamental(rows, 100 * seed + k) if k < OUTLYING else fit_to_all(rows).F
        for k, rows in enumerate(sequence.matches.values())
    ]
    K = sequence.K @ np.diag([1.0 + FOCAL_OFF, 1.0 + FOCAL_OFF, 1.0])
    return error_discrepancies(np.array(Fs), K, K - sequence.K)
