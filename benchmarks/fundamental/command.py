"""Fundamental matrices: estimators of sfm_app, OpenCV, PoseLib and pycolmap, compared in one run on one thread.

    python -m benchmarks.fundamental --real DATA --ratio DATA --cache CACHE
    python -m benchmarks.fundamental --synthetic 200 --two-motions 100
    python -m benchmarks.fundamental --real DATA --ablation

Methods alternate pair by pair after a warm-up call, with the same threshold, confidence and limit. Ours are called
through the public API and may reject a pair, which counts as a failure; rivals are called directly.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.command_line import add_pictures, ensure_single_thread, is_wanted, new_parser
from benchmarks.common.figures import add_legend, draw_curves, label, pyplot, save
from benchmarks.common.metrics import (
    CAP_PX,
    area_under_recall,
    fundamental_pose_error_deg,
    mean_sampson_px,
    rms_sampson_px,
    summary_px,
)
from benchmarks.common.results import RESULTS, Row, document, pivot, table, write
from benchmarks.common.timing import Method, take_turns, timing
from benchmarks.fundamental.ablation import ablated_estimators
from benchmarks.fundamental.facades import cached_facade_pairs
from benchmarks.fundamental.methods import BASELINE, QUICK, RIVALS, our_estimators, rivals
from benchmarks.fundamental.real_pairs import (
    LEAST_SHARE,
    LEAST_TRUE,
    TRUE_PX,
    RealPair,
    cached_ratio_matches,
    load_pairs,
)
from benchmarks.synthetic.matches import make_two_motions
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair

THRESHOLD_PX, CONFIDENCE, MAX_TRIALS = 1.5, 0.9999, 20_000
OURS = ("lev-ransac", "lev-ransac-thesis", "msac")
POSE_LIMITS_DEG = (5, 10, 20)
OUTLIERS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
MOTIONS = ((0.1, 0.1), (0.1, 0.2), (0.2, 0.1), (0.2, 0.2), (0.3, 0.1), (0.3, 0.2), (0.4, 0.1))
"""Share of the matches on the moving object, share of outliers; the still scene always has the most matches."""
FOUND_PX = 1.0
"""The dominant geometry counts as found when its exact matches are closer than this on average."""
DRAWN = ("real", "ratio", "synthetic")
"""Comparisons that can be drawn."""
RATIO_SETS = ("fountain-P11", "castle-P19", "Herz-Jesus-P8", "merton1", "temple16")


def score_real(pairs: Sequence[RealPair], methods: Mapping[str, Method], seed: int) -> tuple[list[Row], dict[str, Any]]:
    """Score pose errors, distances of the true inliers and times; also return the pose errors by method."""
    attempts = take_turns(methods, pairs, seed, "pairs")
    errors: dict[str, NDArray[np.float64]] = {}
    rows = []
    for name, tries in attempts.items():
        answers = list(zip(pairs, tries, strict=True))
        errors[name] = np.array([fundamental_pose_error_deg(a.F, (p.K1, p.K2), p.R, p.t) for p, a in answers])
        rms = [rms_sampson_px(a.F, p.x1[p.is_true], p.x2[p.is_true]) for p, a in answers]
        row: Row = {"method": name}
        row |= {f"AUC@{limit}": round(area_under_recall(errors[name], limit), 4) for limit in POSE_LIMITS_DEG}
        row |= {"rms px": _round_finite(np.median(rms)), "no F": sum(a.F is None for a in tries), **timing(tries)}
        for photos in dict.fromkeys(pair.photos for pair in pairs):
            of_set = errors[name][[pair.photos == photos for pair in pairs]]
            row[f"{photos} AUC@10"] = round(area_under_recall(of_set, 10), 4)
        rows.append(row)
    _add_time_ratios(rows, "ms total")
    return rows, errors


def run_real(task: str, files: list[Path], methods: Mapping[str, Method], args: argparse.Namespace) -> None:
    """Compare the methods on pairs of photos."""
    pairs = load_pairs(files, args.pairs_per_set)
    if not pairs:
        raise SystemExit(f"no usable pairs in {', '.join(map(str, files)) or 'no file'}")
    shares = np.array([pair.is_true.mean() for pair in pairs])
    counts = np.array([len(pair.x1) for pair in pairs])
    data = {
        "sets": {path.stem: sum(pair.photos == path.stem for pair in pairs) for path in files},
        "pairs": len(pairs),
        "true inlier share": [round(float(value), 3) for value in np.quantile(shares, (0, 0.5, 1))],
        "matches": [int(value) for value in np.quantile(counts, (0, 0.5, 1))],
        "left out": f"pairs with a share of true inliers under {LEAST_SHARE} or fewer than {LEAST_TRUE} of them",
    }
    rows, errors = score_real(pairs, methods, args.seed)
    about = (
        f"{len(pairs)} pairs, {counts.min()} to {counts.max()} matches, true inlier share {shares.min():.2f} to "
        f"{shares.max():.2f} (median {np.median(shares):.2f}). AUC of the larger of rotation and translation error; "
        "rms px: median over the pairs of the RMS Sampson distance of the true inliers (within "
        f"{TRUE_PX:g} px of the truth)."
    )
    by_set = [column for column in rows[0] if column.endswith(" AUC@10")]
    tables = {
        "All pairs": table(rows, [column for column in rows[0] if column not in by_set]),
        "AUC@10 by photo set": table(rows, ["method", *by_set]),
    }
    if is_wanted(args.pictures, task):
        draw_recall(errors, _title(task), args.results, _name(task, args))
    _publish(task, about, data, rows, args, tables)


def draw_recall(errors: Mapping[str, NDArray[np.float64]], title: str, folder: Path, name: str) -> None:
    """Draw the recall over the pose error, one line per method."""
    figure, axes = pyplot().subplots(figsize=(7.5, 3.6))
    for name, values in errors.items():
        recall = np.arange(1, len(values) + 1) / len(values)
        axes.step(np.sort(values), recall, where="post", label=name, linewidth=2.4 if name == OURS[0] else 1.2)
    axes.set(xlim=(0, POSE_LIMITS_DEG[-1]), ylim=(0, 1))
    label(axes, "pose error, degrees", "share of the pairs", title)
    add_legend(figure, axes)
    save(figure, folder, name)


def run_synthetic(tests: int, methods: Mapping[str, Method], args: argparse.Namespace) -> None:
    """Compare the methods on the pairs of thesis section 4.8."""
    rows: list[Row] = []
    for outliers in OUTLIERS:
        pairs = [make_pair(PairOptions(outliers=outliers), args.seed + n) for n in range(tests)]
        for name, tries in take_turns(methods, pairs, args.seed, f"{100 * outliers:.0f} % outliers").items():
            errors = [mean_sampson_px(a.F, p.exact_x1, p.exact_x2) for p, a in zip(pairs, tries, strict=True)]
            rows.append({"method": name, "outliers": outliers, **summary_px(np.array(errors)), **timing(tries)})
    about = (
        f"{tests} pairs per level as in thesis section 4.8: 1200 matches, 512 x 512, focal length 700, 1 px noise. "
        f"Errors: mean Sampson distance of the exact matches. A failure is no answer or an error above {CAP_PX:g} px; "
        f"the mean leaves failures out, the capped mean counts them as {CAP_PX:g} px."
    )
    times = pivot(rows, "outliers", "ms mean")
    for row in times:
        row["70 % : 10 %"] = round(row["0.7"] / row["0.1"], 2)
    tables = {
        "Mean error, px": table(pivot(rows, "outliers", "mean px")),
        "Capped mean error, px": table(pivot(rows, "outliers", "capped mean px")),
        "Failures": table(pivot(rows, "outliers", "failures")),
        "Mean time, ms": table(times),
    }
    if is_wanted(args.pictures, "synthetic"):
        draw_levels(rows, args.results, _name("synthetic", args))
    _publish("synthetic", about, {"tests per level": tests, "outliers": list(OUTLIERS)}, rows, args, tables)


def draw_levels(rows: Sequence[Row], folder: Path, name: str) -> None:
    """Draw error and time over the share of outliers, one line per method."""
    figure, (left, right) = pyplot().subplots(1, 2, figsize=(10, 3.8))
    for axes, value in ((left, "capped mean px"), (right, "ms mean")):
        lines = {row.pop("method"): list(row.values()) for row in pivot(rows, "outliers", value)}
        draw_curves(axes, [100 * level for level in OUTLIERS], lines, OURS[:1])
    label(left, "outliers, %", "mean error, px (failures as 5)", log=True)
    label(right, "outliers, %", "mean time, ms", log=True)
    add_legend(figure, left)
    save(figure, folder, name)


def run_two_motions(tests: int, methods: Mapping[str, Method], args: argparse.Namespace) -> None:
    """Compare the methods on pairs with an independently moving object."""
    rows: list[Row] = []
    for moving, outliers in MOTIONS:
        options = PairOptions(outliers=outliers)
        scenes = [make_two_motions(options, moving, args.seed + n) for n in range(tests)]
        pairs, title = [scene.pair for scene in scenes], f"{100 * moving:.0f} % + {100 * outliers:.0f} %"
        for name, tries in take_turns(methods, pairs, args.seed, title).items():
            errors = np.array([
                mean_sampson_px(a.F, s.pair.exact_x1[~s.is_moving], s.pair.exact_x2[~s.is_moving])
                for s, a in zip(scenes, tries, strict=True)
            ])  # fmt: skip
            found = round(float(np.mean(errors < FOUND_PX)), 4)
            rows.append(
                {"method": name, "moving + outliers": title, "found": found, **summary_px(errors), **timing(tries)}
            )
    about = (
        f"{tests} pairs per column: 1200 matches, of which a share lies on an object with its own rigid motion and a "
        f"share is wrong. Found: the mean Sampson distance of the still scene's exact matches is under {FOUND_PX:g} px."
    )
    across = "moving + outliers"
    tables = {
        "Share in which the dominant geometry is found": table(pivot(rows, across, "found")),
        "Capped mean error, px": table(pivot(rows, across, "capped mean px")),
        "Mean time, ms": table(pivot(rows, across, "ms mean")),
    }
    data = {"tests per level": tests, "moving, outliers": [list(pair) for pair in MOTIONS]}
    _publish("two-motions", about, data, rows, args, tables)


def _publish(
    task: str, about: str, data: Mapping[str, Any], rows: list[Row], args: argparse.Namespace, tables: Mapping[str, str]
) -> None:
    options = {"threshold px": THRESHOLD_PX, "confidence": CONFIDENCE, "most trials": MAX_TRIALS, "seed": args.seed}
    found = document(f"fundamental {task}", about, options, data, rows)
    limits = f"Threshold {THRESHOLD_PX} px, confidence {CONFIDENCE}, at most {MAX_TRIALS} samples, one thread, one run."
    body = "\n".join(f"## {title}\n\n{text}" for title, text in tables.items())
    page = f"# {_title(task)}\n\n{about} {limits}\n\n{body}"
    if task in DRAWN and is_wanted(args.pictures, task):
        page += f"\n![{_title(task)}]({_name(task, args)}.png)\n"
    write(args.results, _name(task, args), found, page)
    print(page)


def _title(task: str) -> str:
    return {
        "real": "Fundamental matrices on real matches without a ratio test",
        "ratio": "Fundamental matrices on real matches after the ratio test",
        "facades": "Fundamental matrices on rendered facades without a ratio test",
        "synthetic": "Fundamental matrices on synthetic pairs",
        "two-motions": "Fundamental matrices with two motions",
    }[task]


def _name(task: str, args: argparse.Namespace) -> str:
    return f"fundamental-{task}" + ("-ablation" if args.ablation else "")


def _add_time_ratios(rows: list[Row], column: str) -> None:
    """Divide every time by that of the baseline, where the baseline was measured."""
    times = {row["method"]: row[column] for row in rows}
    for row in rows if BASELINE in times else []:
        row["time : MAGSAC++"] = round(row[column] / times[BASELINE], 3)


def _round_finite(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("fundamental", __doc__)
    parser.add_argument("--real", type=Path, metavar="DATA", help="folder with pairs/*.npz (see real_pairs.py)")
    parser.add_argument("--ratio", type=Path, metavar="DATA", help="folder with NAME/images and NAME/cameras.json")
    parser.add_argument(
        "--facades", type=int, metavar="N", help="rendered facades, most of whose matches lie in a plane"
    )
    parser.add_argument("--cache", type=Path, help="where the matches of --ratio and --facades are kept")
    parser.add_argument("--sets", nargs="+", default=RATIO_SETS, help="photo sets of --ratio")
    parser.add_argument("--pairs-per-set", type=int, help="limit of pairs per set, evenly spaced")
    parser.add_argument("--synthetic", type=int, metavar="N", help="pairs per level of outliers; 200 in the thesis")
    parser.add_argument("--two-motions", type=int, metavar="N", help="pairs per level")
    parser.add_argument("--methods", nargs="+", default=OURS, help="estimators of sfm_app (see `sfm-app plugins`)")
    parser.add_argument("--rivals", nargs="*", default=QUICK, choices=RIVALS, help="other estimators; the quick ones")
    parser.add_argument("--ablation", action="store_true", help="not --methods, but lev-ransac with a part missing")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, default=RESULTS)
    add_pictures(parser, 'comparisons, such as "real"')
    return parser


def parse_arguments() -> argparse.Namespace:
    """Read the command line, and refuse options that do not fit together."""
    line = parser()
    args = line.parse_args()
    if not any((args.real, args.ratio, args.facades, args.synthetic, args.two_motions)):
        line.error("name at least one of --real, --ratio, --facades, --synthetic, --two-motions")
    if (args.ratio or args.facades) and not args.cache:
        line.error("--ratio and --facades need --cache")
    return args


def main() -> None:
    """Run the comparisons that were asked for."""
    args = parse_arguments()
    ensure_single_thread()
    options = EpipolarSettings(max_error_px=THRESHOLD_PX, confidence=CONFIDENCE, max_trials=MAX_TRIALS)
    methods = (ablated_estimators(options) if args.ablation else our_estimators(args.methods, options)) | rivals(
        args.rivals, options
    )
    if args.real:
        run_real("real", sorted((args.real / "pairs").glob("*.npz")), methods, args)
    if args.ratio:
        run_real("ratio", [cached_ratio_matches(args.ratio, name, args.cache) for name in args.sets], methods, args)
    if args.facades:
        run_real("facades", [cached_facade_pairs(k, args.cache) for k in range(args.facades)], methods, args)
    if args.synthetic:
        run_synthetic(args.synthetic, methods, args)
    if args.two_motions:
        run_two_motions(args.two_motions, methods, args)
