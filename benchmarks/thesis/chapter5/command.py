"""The figures and tables of thesis chapter 5 from our own calibrators, compared with the claims of the thesis.

    python -m benchmarks.thesis.chapter5 DATA --tests 100 --runs 50
    python -m benchmarks.thesis.chapter5 DATA --only 5.1 5.18 --results /tmp/part
    python -m benchmarks.thesis.chapter5 DATA --quick --results /tmp/quick

DATA holds vgg-corners, castle-P19 and fountain-P11. Output: chapter5.md and chapter5.json, and with --pictures a
PNG and a CSV of its points for every figure.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from benchmarks.common.command_line import add_pictures, ensure_single_thread, is_wanted, new_parser
from benchmarks.common.figures import pyplot
from benchmarks.common.results import RESULTS, document, table, write
from benchmarks.thesis.chapter5.bounds import draw_bounds, draw_discrepancies
from benchmarks.thesis.chapter5.contests import CAP_PERCENT, METHODS, MULTI_START, PRODUCTION
from benchmarks.thesis.chapter5.lab import FigureResult, Lab
from benchmarks.thesis.chapter5.setups import NOISE_PX
from benchmarks.thesis.chapter5.slices import (
    draw_kruppa_noise,
    draw_one_outlier,
    draw_parallel_axes,
    draw_surfaces,
    draw_wrong_center,
)
from benchmarks.thesis.chapter5.sweeps import FIGURES as SWEEPS
from benchmarks.thesis.chapter5.sweeps import draw_sweep
from benchmarks.thesis.chapter5.tables import compare_real_sequences
from benchmarks.thesis.chapter5.zero_curve_plots import (
    draw_degenerate_pairs,
    draw_example_curves,
    draw_outlying_curves,
    draw_timing,
    draw_two_cameras,
)

TABLES = "tables"
PARTS: Mapping[str, Callable[[Lab], FigureResult]] = {
    "5.1": draw_one_outlier,
    "5.2": draw_parallel_axes,
    "5.3": draw_wrong_center,
    "5.4": draw_surfaces,
    "5.5": draw_kruppa_noise,
    "5.7-5.8": draw_bounds,
    "5.9": draw_discrepancies,
    "5.11": draw_example_curves,
    "5.12": draw_outlying_curves,
    "5.14": draw_timing,
    "5.15": draw_two_cameras,
    "5.16": draw_degenerate_pairs,
    **{number: partial(draw_sweep, number=number) for number in SWEEPS},
    TABLES: compare_real_sequences,
}
"""The function that draws each figure."""
ORDERED_PARTS = sorted(PARTS, key=lambda name: 99 if name == TABLES else int(name.removeprefix("5.").split("-")[0]))
TEST_LIMITS = ((MULTI_START, 20), (PRODUCTION, 20))
"""Limits on the tests of slow methods; all else is done in about ten minutes."""
CACHE = Path.home() / ".cache" / "sfm-app-benchmarks"


def setting_text(lab: Lab) -> str:
    """Describe the setting that all figures share."""
    return (
        f"{lab.tests} tests a level, {lab.runs} runs a sequence ({lab.test_limits_text}), "
        f"seed {lab.seed}. Synthetic sequences are those of section 5.5.3: five cameras, 512 x 512, 200 points, fx 500 "
        f"to 1000, fy/fx 0.8 to 1.2, the center up to 10 % off, and {NOISE_PX} px of noise, which the thesis does not "
        "name. F's come from LEV-RANSAC; an outlying F is fitted to all its matches by the 8-point algorithm. e_focal "
        f"and e_OC are those of section 5.5.3, at most {CAP_PERCENT:g} % each, as means over the answers; medians and "
        "the share of answers are in the JSON file. `zero-curves-thesis`, `multi-start`, `perturbation`, `geometric`, "
        f"`huang-faugeras` (non-robust) and `kruppa` are the thesis's methods, which always answer; `{PRODUCTION}` is "
        "what the program uses, and may decline. The claims are about the former."
    )


def page(lab: Lab, drawn: Mapping[str, FigureResult]) -> str:
    """Return the Markdown page."""
    claimed = [
        {"figure": claim.figure, "the thesis": claim.says, "here": claim.verdict, "numbers": claim.numbers}
        for part in drawn.values()
        for claim in part.claims
    ]
    parts = ["# Chapter 5: the thesis's figures and ours", setting_text(lab), "## Claims", table(claimed)]
    declined = answer_shares(drawn)
    if declined:
        parts += [f"## Share of tests that {PRODUCTION} answers", table(declined)]
    for name in sorted(drawn, key=lambda name: name != TABLES):
        title = "Tables 5.2 and 5.3" if name == TABLES else f"Figure {name}"
        shown = name != TABLES and is_wanted(lab.pictures, name)
        image = f"![{title}](chapter5-figure-{name}.png)" if shown else ""
        body = [text for text in (drawn[name].note, drawn[name].tables, image) if text]
        parts += [f"## {title}", *body] if body else []
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def answer_shares(drawn: Mapping[str, FigureResult]) -> list[dict[str, object]]:
    """Return, per experiment and level, the share of tests that the production method answers."""
    rows = [row for part in drawn.values() for row in part.rows if row["method"] == PRODUCTION and "part" in row]
    found: dict[str, dict[str, object]] = {}
    for row in rows:
        entry = found.setdefault(row["part"], {"figure": row["part"], "level: share": ""})
        entry["level: share"] = f"{entry['level: share']} {row['x']:g}: {row['answered']:.2f}".strip()
    return list(found.values())


def parse_test_limit(text: str) -> tuple[str, int]:
    """Parse METHOD=N of the command line."""
    method, _, count = text.partition("=")
    return method, int(count)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("thesis.chapter5", __doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--tests", type=int, default=20, help="seeds per level; 100 in the thesis")
    parser.add_argument("--runs", type=int, default=10, help="seeds per real sequence; 50 in the thesis")
    parser.add_argument(
        "--most",
        nargs="*",
        default=TEST_LIMITS,
        type=parse_test_limit,
        metavar="METHOD=N",
        help="limit both for slow methods",
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=ORDERED_PARTS,
        default=ORDERED_PARTS,
        metavar="FIGURE",
        help=", ".join(ORDERED_PARTS),
    )
    parser.add_argument("--methods", nargs="+", default=METHODS, help="calibrators; all by default")
    parser.add_argument("--quick", action="store_true", help="2 seeds of everything")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--cache", type=Path, default=CACHE, help="where matches of photos are kept")
    parser.add_argument("--results", type=Path, default=RESULTS)
    add_pictures(parser, 'figures, such as "5.18"')
    return parser


def main() -> None:
    """Draw every figure, judge the claims, and write the results."""
    args = parser().parse_args()
    ensure_single_thread()
    pyplot()  # fails here if matplotlib is missing, not after an hour of work
    tests, runs = (2, 2) if args.quick else (args.tests, args.runs)
    most = dict(args.most)
    args.results.mkdir(parents=True, exist_ok=True)
    drawn = {}
    with ProcessPoolExecutor(args.workers, mp_context=get_context("spawn")) as pool:
        lab = Lab(args.data, args.cache, args.results, args.methods, tests, runs, most, args.seed, pool, args.pictures)
        for name in (name for name in ORDERED_PARTS if name in args.only):
            start = time.perf_counter()
            drawn[name] = PARTS[name](lab)
            print(f"{name}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    options = {"tests": tests, "runs": runs, "most": most, "seed": args.seed, "cap %": CAP_PERCENT}
    claims = [asdict(claim) for part in drawn.values() for claim in part.claims]
    rows = [{"figure": name, **row} for name, part in drawn.items() for row in part.rows]
    rows = rows or [{"figure": name, "method": "none"} for name in drawn]
    text = page(lab, drawn)
    write(args.results, "chapter5", document("chapter 5", setting_text(lab), options, {"claims": claims}, rows), text)
    print(text)
