"""The figures of thesis chapter 4 from our own estimators, compared with the claims of the thesis.

    python -m benchmarks.thesis.chapter4 DATA --tests 200
    python -m benchmarks.thesis.chapter4 DATA --quick

DATA holds vgg-corners/Merton-College-I and vgg-corners/Wadham-College. Output: chapter4.md and chapter4.json, and
with --pictures a PNG for every figure.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.command_line import add_pictures, ensure_single_thread, is_wanted, new_parser
from benchmarks.common.figures import add_legend, draw_curves, label, pyplot, save
from benchmarks.common.metrics import CAP_PX, mean_sampson_px, summary_px
from benchmarks.common.results import RESULTS, Row, document, finite_or_none, pivot, table, write
from benchmarks.common.timing import take_turns, timing
from benchmarks.thesis.chapter4.best_models import refits, trace
from benchmarks.thesis.chapter4.claims import claim_of_refits, claims_of_sweep, claims_of_traces, curve
from benchmarks.thesis.chapter4.searches import searches
from benchmarks.thesis.claims import Claim
from benchmarks.thesis.corners import load_corners, with_outliers
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair

THRESHOLD_PX, CONFIDENCE = 1.96, 0.9999
PRODUCTION, LITERAL = "lev-ransac", "lev-ransac-thesis"
SWEEPS = {
    "4.11": ("ransac", "msac", "mlesac", "res-ransac", LITERAL, PRODUCTION),
    "4.12": ("ransac", LITERAL, "ransac-tdd", "lev-ransac-tdd"),
    "4.13": ("ransac", LITERAL, "ransac-sprt", "lev-ransac-sprt"),
}
"""Estimators of each figure."""
LEVELS, QUICK_LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8), (0.1, 0.3, 0.5, 0.7)
SEQUENCES = {"Merton": ("Merton-College-I", 0.3), "Wadham": ("Wadham-College", 0.5)}
"""Folder under vgg-corners, and the share of artificial outliers."""
REACH_PX = 256.0
REPEATS = 100
STATISTICS = {"mean": "mean", "std": "deviation of the"}
TRACED = {
    "4.7": (("residual mean", "residual std"), "residual, px"),
    "4.8": (("cook mean",), "Cook's distance"),
    "4.9": (("prior mean",), "prior p(v)"),
}
"""Columns of each figure, and the name of its axis."""


def run_sweep(tests: int, levels: Sequence[float], options: EpipolarSettings, seed: int) -> list[Row]:
    """Run every estimator on the same pairs at every level (section 4.8); one row each."""
    methods = searches(list(dict.fromkeys(name for names in SWEEPS.values() for name in names)), options)
    rows = []
    for outliers in levels:
        pairs = [make_pair(PairOptions(outliers=outliers), seed + n) for n in range(tests)]
        for name, tries in take_turns(methods, pairs, seed, f"{100 * outliers:.0f} % outliers").items():
            errors = [mean_sampson_px(a.F, p.exact_x1, p.exact_x2) for p, a in zip(pairs, tries, strict=True)]
            capped = sum(a.trials is not None and a.trials >= options.max_trials for a in tries)
            row: Row = {"method": name, "outliers": outliers, **summary_px(np.array(errors))}
            row["refit px"] = round(float(methods[name].errors_after_refit_px(pairs).mean()), 4)
            rows.append(row | timing(tries) | {"stopped by the limit": capped})
    return rows


def run_traces(data: Path, options: EpipolarSettings, seed: int, *, guided: bool) -> dict[str, list[Row]]:
    """Return mean and standard deviation over true inliers and outliers, per sequence and best model."""
    found: dict[str, list[Row]] = {}
    for name, (folder, share) in SEQUENCES.items():
        x1, x2 = load_corners(data / "vgg-corners" / folder, 1, 2)
        x2, is_inlier = with_outliers(x2, share, REACH_PX, seed)
        rows = []
        for number, best in enumerate(trace(x1, x2, options, seed, guided=guided), 1):
            row: Row = {"best model": number, "trial": best.trial}
            for quantity, values in (("residual", best.residuals_px), ("cook", best.cook), ("prior", best.priors)):
                for who, chosen in (("inliers", is_inlier), ("outliers", ~is_inlier)):
                    row[f"{who} {quantity} mean"] = float(values[chosen].mean())
                    row[f"{who} {quantity} std"] = float(values[chosen].std())
            rows.append(row)
        found[f"{name}, {100 * share:.0f} % outliers"] = rows
    return found


def draw_sweep(figure_name: str, rows: Sequence[Row], folder: Path) -> bool:
    """Draw error and time over the outlier ratio; False where none of the figure's own estimators was measured."""
    names = [name for name in SWEEPS[figure_name] if any(row["method"] == name for row in rows)]
    chosen = [row for name in names for row in rows if row["method"] == name]
    heavy = [LITERAL] if figure_name == "4.11" else [name for name in names if name not in SWEEPS["4.11"]]
    if not set(heavy) & set(names):
        return False
    figure, axes = pyplot().subplots(1, 2, figsize=(10, 3.8))
    levels = sorted({row["outliers"] for row in rows})
    for axis, part, column, title in (
        (axes[0], "a", "capped mean px", "mean Sampson error, px"),
        (axes[1], "b", "ms mean", "mean time, ms"),
    ):
        lines = {name: [curve(chosen, name, column)[level] for level in levels] for name in names}
        draw_curves(axis, [100 * level for level in levels], lines, heavy)
        label(axis, "outliers, %", title, f"{figure_name}{part}", log=True)
    add_legend(figure, axes[0])
    save(figure, folder, f"chapter4-figure-{figure_name}")
    return True


def draw_traces(figure_name: str, traces: dict[str, list[Row]], folder: Path) -> None:
    """Draw inliers against outliers over the best models, one plot per sequence and quantity."""
    columns, title = TRACED[figure_name]
    figure, axes = pyplot().subplots(len(columns), len(traces), figsize=(9, 2.9 * len(columns)), squeeze=False)
    for j, (name, found) in enumerate(traces.items()):
        numbers = [row["best model"] for row in found]
        for i, column in enumerate(columns):
            lines = {who: [row[f"{who} {column}"] for row in found] for who in ("inliers", "outliers")}
            draw_curves(axes[i][j], numbers, lines)
            label(
                axes[i][j],
                "best model, in the order found",
                f"{STATISTICS[column.split()[1]]} {title}",
                name,
                log=figure_name != "4.9",
            )
            axes[i][j].xaxis.get_major_locator().set_params(integer=True)
    axes[0][0].legend()
    save(figure, folder, f"chapter4-figure-{figure_name}")


def rows_of_traces(figure_name: str, traces: dict[str, list[Row]]) -> list[Row]:
    """Return the rows of a figure of `TRACED`, with its own quantity only."""
    quantity = TRACED[figure_name][0][0].split()[0]
    rows = [{"sequence": name, **row} for name, found in traces.items() for row in found]
    return [
        {key: finite_or_none(value) for key, value in row.items() if len(key.split()) != 3 or quantity in key}
        for row in rows
    ]


def draw_refits(rows: Sequence[Row], folder: Path) -> None:
    """Draw Figure 4.4: the mean residual of every sample's model before and after its refits, sorted by the first."""
    ordered = sorted(rows, key=lambda row: row["7-point"])
    figure, axes = pyplot().subplots(figsize=(7, 3.4))
    for n, name in enumerate(ordered[0]):
        axes.plot([row[name] for row in ordered], "osD"[n], label=name, color=f"C{n}")
    label(
        axes, "samples, in the order of their 7-point residuals", "mean residual, px", "Merton, no outliers", log=True
    )
    axes.legend()
    save(figure, folder, "chapter4-figure-4.4")


def draw_all(
    args: argparse.Namespace, refitted: Sequence[Row], traces: Mapping[str, dict[str, list[Row]]], rows: Sequence[Row]
) -> list[str]:
    """Draw the figures that were asked for, and return their numbers."""
    drawn = [name for name in ("4.4", *TRACED, *SWEEPS) if is_wanted(args.pictures, name)]
    if "4.4" in drawn:
        draw_refits(refitted, args.results)
    for name in set(drawn) & set(TRACED):
        draw_traces(name, traces[name], args.results)
    return [name for name in drawn if name not in SWEEPS or draw_sweep(name, rows, args.results)]


def page(claims: Sequence[Claim], rows: Sequence[Row], drawn: Sequence[str], setting: str) -> str:
    """Return the Markdown page."""
    claimed = [{"figure": c.figure, "the thesis": c.says, "here": c.verdict, "numbers": c.numbers} for c in claims]
    parts = ["# Chapter 4: the thesis's figures and ours", setting, "## Claims", table(claimed)]
    for title, column in (
        ("Mean error of the best model of the search, px", "capped mean px"),
        ("Mean error after the final refit, px", "refit px"),
        ("Failures: the best model is more than 5 px off", "failures"),
        ("Mean time, ms", "ms mean"),
        ("Mean number of trials", "trials mean"),
        ("Pairs that were stopped by the limit of trials", "stopped by the limit"),
    ):
        parts += [f"## {title}", table(pivot(rows, "outliers", column))]
    parts += [f"## Figure {name}\n\n![Figure {name}](chapter4-figure-{name}.png)" for name in drawn]
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("thesis.chapter4", __doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--tests", type=int, default=20, help="pairs per level; 200 in the thesis")
    parser.add_argument("--max-trials", type=int, default=50_000, help="limit of samples; see Eq. 3.19")
    parser.add_argument("--quick", action="store_true", help="3 pairs at four levels, at most 10 000 trials")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, default=RESULTS)
    add_pictures(parser, 'figures, such as "4.11"')
    return parser


def main() -> None:
    """Measure, judge the claims, and write the results."""
    args = parser().parse_args()
    ensure_single_thread()
    tests, most, levels = (3, 10_000, QUICK_LEVELS) if args.quick else (args.tests, args.max_trials, LEVELS)
    options = EpipolarSettings(max_error_px=THRESHOLD_PX, confidence=CONFIDENCE, max_trials=most)
    args.results.mkdir(parents=True, exist_ok=True)

    merton = load_corners(args.data / "vgg-corners" / SEQUENCES["Merton"][0], 1, 2)
    refitted = list(refits(*merton, options, REPEATS, args.seed))
    uniform, guided = (run_traces(args.data, options, args.seed, guided=guided) for guided in (False, True))
    rows = run_sweep(tests, levels, options, args.seed)

    traces = {name: uniform if name == "4.7" else guided for name in TRACED}
    drawn = draw_all(args, refitted, traces, rows)
    claims = [
        claim_of_refits(refitted),
        *claims_of_traces(uniform, ("4.7",)),
        *claims_of_traces(guided, ("4.8", "4.9")),
    ]
    claims += claims_of_sweep(rows)
    setting = (
        f"{tests} pairs per level as in section 4.8 (512 x 512, focal length 700, 1200 matches, 1 px noise), threshold "
        f"{THRESHOLD_PX} px, confidence {CONFIDENCE}, one thread, one run. At most {most} samples; Eq. 3.19 asks "
        "uniform sampling for 42 000 at 70 % outliers and for 720 000 at 80 %. Errors are mean Sampson distances of "
        f"the exact matches, at most {CAP_PX:g} px each. Errors in figures and claims are those of the best model of "
        "the search, which is what Algorithm 1 returns, and times are of the search alone; the program refits to the "
        f"inliers afterwards. `{LITERAL}` is Algorithm 1, `{PRODUCTION}` what the program uses (its search refits "
        "every new best model); the claims are about the former."
    )
    data: dict[str, Any] = {
        "tests per level": tests,
        "outliers": list(levels),
        "claims": [asdict(claim) for claim in claims],
        "figures": {"4.4": refitted} | {name: rows_of_traces(name, found) for name, found in traces.items()},
    }
    limits = {"threshold px": THRESHOLD_PX, "confidence": CONFIDENCE, "most trials": most, "seed": args.seed}
    text = page(claims, rows, drawn, setting)
    write(args.results, "chapter4", document("chapter 4", setting, limits, data, rows), text)
    print(text)
