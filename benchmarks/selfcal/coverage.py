"""Coverage of the stated standard deviations: how often the truth lies within them in synthetic calibrations."""

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.common.metrics import focal_error_percent
from benchmarks.common.results import Row
from benchmarks.selfcal.score import INSIDE, PARAMETER_ENTRIES, center_error_percent, deviations
from sfm_app.plugins import load_plugins
from sfm_app.selfcal import pair_weights
from sfm_app.settings import Settings
from sfm_app.synthetic.correspondences import TrackOptions, Tracks, make_tracks
from sfm_app.types import Calibration, CameraPairs, EpipolarFit

CAMERAS = (5, 12)
SIGMA_PX = (0.3, 1.0)
ASPECT = (0.8, 1.2)
SQUARE_SHARE = 0.5
"""Share of the trials with square pixels; the others draw fy/fx from `ASPECT`."""
OUTLIERS = 0.2


class Trial(NamedTuple):
    """One synthetic set of photos, and its calibration."""

    options: TrackOptions
    found: Calibration
    row: Row


def sample_options(seed: int) -> TrackOptions:
    """Sample a setup: five to twelve photos of a random camera, with wrong matches in every pair."""
    rng = np.random.default_rng([seed, 55])
    cameras = int(rng.integers(CAMERAS[0], CAMERAS[1] + 1))
    return TrackOptions(
        cameras=cameras,
        points=int(rng.integers(150, 400)),
        sigma_px=float(rng.uniform(*SIGMA_PX)),
        corrupted_pairs=cameras * (cameras - 1) // 2,
        outliers=OUTLIERS,
        width=1024,
        height=768,
        focal_px=(700.0, 2000.0),
        aspect=(1.0, 1.0) if rng.uniform() < SQUARE_SHARE else ASPECT,
        center_offset=0.1,
    )


def estimate_pairs(tracks: Tracks, settings: Settings, seed: int) -> CameraPairs:
    """Estimate the fundamental matrices of the tracks' pairs with the program's own estimator."""
    fit = load_plugins().estimator(settings.epipolar.estimator).fit
    fits = {
        pair: (view, fit(view.x1, view.x2, settings.epipolar, seed + n))
        for n, (pair, view) in enumerate(tracks.pairs.items())
    }
    good = {pair: (v, f) for pair, (v, f) in fits.items() if isinstance(f, EpipolarFit) and not f.degeneracy}
    return CameraPairs(
        Fs=np.array([fit.F for _, fit in good.values()]).reshape(-1, 3, 3),
        weights=pair_weights([fit.inlier_count for _, fit in good.values()]),
        size=tracks.size,
        photos=tuple(good),
        inliers=tuple(np.hstack([view.x1, view.x2])[fit.inliers] for view, fit in good.values()),
    )


def run_trial(seed: int, settings: Settings) -> Trial:
    """Sample a setup, estimate, calibrate, and compare."""
    options = sample_options(seed)
    tracks = make_tracks(options, seed)
    pairs = estimate_pairs(tracks, settings, seed)
    found = load_plugins().calibrator(settings.calibration.calibrator).calibrate(pairs, settings.calibration, seed)
    K = tracks.K[0]
    row: Row = {
        "method": settings.calibration.calibrator, "seed": seed, "cameras": options.cameras, "pairs": len(pairs.Fs),
        "sigma px": round(options.sigma_px, 3), "fy/fx": round(float(K[1, 1] / K[0, 0]), 3),
        "known": found.identifiable,
        "e_focal %": round(focal_error_percent(found.K, K), 3),
        "center % of width": round(center_error_percent(found, K), 3),
        "k1": round(found.radial, 4), "held": " ".join(found.held),
    }  # fmt: skip
    away = deviations(found, K) if found.identifiable else {}
    return Trial(
        options,
        found,
        row | {f"{name} sd": round(away[name], 3) if name in away else None for name in PARAMETER_ENTRIES},
    )


def run_trials(count: int, settings: Settings, first_seed: int = 0) -> list[Trial]:
    """Run `count` trials; seeds count up from the first."""
    trials = []
    for seed in range(first_seed, first_seed + count):
        trials.append(run_trial(seed, settings))
        print(f"\rcoverage {len(trials)}/{count}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return trials


KINDS: Mapping[str, Callable[[Trial], bool]] = {
    "all": lambda _: True,
    "5 to 6 cameras": lambda t: t.options.cameras <= 6,
    "7 to 9 cameras": lambda t: 7 <= t.options.cameras <= 9,
    "10 to 12 cameras": lambda t: t.options.cameras >= 10,
    "noise under 0.65 px": lambda t: t.options.sigma_px < 0.65,
    "noise over 0.65 px": lambda t: t.options.sigma_px >= 0.65,
    "square pixels": lambda t: t.options.aspect == (1.0, 1.0),
    "other pixels": lambda t: t.options.aspect != (1.0, 1.0),
}


def summary(trials: Sequence[Trial]) -> list[Row]:
    """Return one row per kind of trial: share of answers, errors, and how often the truth is within its bounds."""
    kinds = {name: [t for t in trials if belongs(t)] for name, belongs in KINDS.items()}
    return [{"method": name, **_figures(chosen)} for name, chosen in kinds.items() if chosen]


def _figures(trials: Sequence[Trial]) -> Row:
    rows = [trial.row for trial in trials if trial.found.identifiable]
    line: Row = {"trials": len(trials), "answered %": round(100 * len(rows) / len(trials), 1)}
    for name in ("e_focal %", "center % of width"):
        for label, share in (("median", 0.5), ("p95", 0.95)):
            line[f"{label} {name}"] = round(float(np.quantile([row[name] for row in rows], share)), 3) if rows else None
    for limit in (1.0, INSIDE):
        for name in PARAMETER_ENTRIES:
            away = [row[f"{name} sd"] for row in rows if row[f"{name} sd"] is not None]
            line[f"{name} in {limit:.0f} sd %"] = _percent([value <= limit for value in away])
    farthest = [max([row[f"{name} sd"] or 0.0 for name in PARAMETER_ENTRIES]) for row in rows]
    return line | {"all in 3 sd %": _percent([value <= INSIDE for value in farthest])}


def _percent(flags: Sequence[bool]) -> float | None:
    return round(100 * float(np.mean(flags)), 1) if flags else None
