"""The camera model that the last bundle adjustment chooses, on synthetic bundles with known lenses.

    python -m benchmarks.lenses.models
    python -m benchmarks.lenses.models --seeds 20 --groups perspective

Each bundle is a model as mapping leaves it (`bundles`), adjusted as in a run. Beside the choice by marginal likelihood
stands that by held-out observations.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.command_line import add_seeds, new_parser
from benchmarks.common.results import Row, document, table, write
from benchmarks.lenses.bundles import (
    SIZE,
    Drawn,
    adjust_like_mapping,
    fisheye_bundle,
    fitted_fisheye,
    perspective_bundle,
    simple_radial,
    write_model,
)
from benchmarks.lenses.radius import radius_error_percent
from sfm_app.bundle.lens_evidence import estimate_lenses
from sfm_app.bundle.lens_parts import PARTS, model_name
from sfm_app.bundle.normal_equations import Bundle, best_step, bundle_scale, project, reduce, residuals
from sfm_app.camera.rows import FISHEYE, PERSPECTIVE
from sfm_app.colmap.backend import pycolmap, show_log
from sfm_app.colmap.bundle import Adjustment, adjust, lens_priors, read_bundle

FloatArray = NDArray[np.float64]

ABOUT = (
    "Synthetic bundles of 12 to 20 photos and 1500 points, noise 0.3 to 0.5 px, 5 % of the keypoints off by more "
    "(Laplace, 3 px). Mapping had one focal and k1 (perspective) or OPENCV_FISHEYE from pairs (fisheye). plain: k1 of "
    "-0.35 to 0.2 that moves the corner by 4 px or more, with k2 (5 px or more) and p1, p2 (4 px or more) in half of "
    "the bundles each. faint: k2 and p1, p2 of any size down to 0.3 px. right: the chosen model is the smallest of "
    "COLMAP's that has the true terms. needless: most terms beyond the true ones. focal %: largest error. "
    "radius %: largest error of the radius of a point of the photo, in percent of its width. held-out: share of the "
    "bundles in which no model makes a held-out fifth of the observations 20 times as likely as the chosen one does."
)
GROUPS = ("plain", "faint", "fisheye")
COLUMNS = (
    "group", "lens", "bundles", "right %", "most needless", "focal % median", "focal % worst", "radius % worst",
    "held-out %", "file models",
)  # fmt: skip
K1 = (-0.35, 0.2)
LEAST_PX = {"plain": (4.0, 5.0, 4.0), "faint": (4.0, 0.3, 0.3)}
"""Least shift of the corner of the photo by k1, by k2 and by p1, p2."""
MOST_PX = (15.0, 8.0)
"""Largest shift by k2, and by p1, p2."""
FIELDS_DEG = (120.0, 150.0, 175.0)
PROJECTIONS = ("equidistant", "equisolid", "stereographic")
FOLDS, REFITS, STRONG = 5, 3, 20.0
"""A fifth is held out; so many steps refit the rest; a ratio of likelihoods that counts as strong evidence (Kass and
Raftery 1995)."""
RIVALS = {
    PERSPECTIVE: ((), ("k1",), ("k1", "k2"), ("k1", "p1 p2"), ("k1", "k2", "p1 p2"), ("k1", "k2", "k3")),
    FISHEYE: ((), ("k1",), ("k1", "k2"), ("k1", "k2", "k3 k4"), ("k1", "p1 p2")),
}
"""Freed parts of the models that are compared on held-out observations."""


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A bundle with its truth."""

    lens: str
    drawn: Drawn
    start: pycolmap.Camera
    true: tuple[str, ...]
    """Parts that the lens has, of PERSPECTIVE_PARTS or FISHEYE_PARTS."""
    exact: bool
    """Whether COLMAP's models have this lens, so that one of them is right."""


def perspective_case(group: str, seed: int) -> Case:
    """Draw a perspective lens, with or without each term."""
    rng = np.random.default_rng([seed, GROUPS.index(group)])
    focal = 1.1 * SIZE[0]
    corner = 0.5 * float(np.hypot(*SIZE)) / focal
    least = LEAST_PX[group]
    k1 = 0.0
    while abs(k1) * corner**3 * focal < least[0]:
        k1 = rng.uniform(*K1)
    bends, tilts = rng.random(2) < 0.5
    k2 = rng.choice([-1, 1]) * rng.uniform(least[1], MOST_PX[0]) / (corner**5 * focal) if bends else 0.0
    shift, angle = rng.uniform(least[2], MOST_PX[1]) / (3.0 * corner**2 * focal), rng.uniform(0.0, 2.0 * np.pi)
    tangential = (shift * np.cos(angle), shift * np.sin(angle)) if tilts else (0.0, 0.0)
    drawn = perspective_bundle((k1, k2) if bends else (k1,), tangential, rng, focal)
    true = ("k1", *(["k2"] if bends else []), *(["p1 p2"] if tilts else []))
    return Case(" ".join(true), drawn, simple_radial(drawn, rng), true, True)


def fisheye_case(group: str, seed: int) -> Case:
    """Draw a fisheye."""
    rng = np.random.default_rng([seed, GROUPS.index(group)])
    kinds = [(projection, field) for projection in PROJECTIONS for field in FIELDS_DEG]
    projection, field = kinds[seed % len(kinds)]
    drawn = fisheye_bundle(projection, field, rng)
    true = () if projection == "equidistant" else ("k1", "k2", "k3 k4")
    return Case(f"{projection} {field:g}", drawn, fitted_fisheye(drawn, rng), true, projection == "equidistant")


CASES: dict[str, Callable[[str, int], Case]] = {
    "plain": perspective_case, "faint": perspective_case, "fisheye": fisheye_case
}  # fmt: skip


def adjust_case(case: Case, folder: Path) -> Adjustment:
    """Adjust a bundle from mapping on."""
    database = folder / "database.db"
    model = write_model(case.drawn, case.start, database)
    adjust_like_mapping(model, lens=case.start.model.name == "SIMPLE_RADIAL")
    return adjust(model, database)


def measure(group: str, seed: int, *, hold_out: bool) -> Row:
    """Adjust one bundle and compare it with the truth."""
    case = CASES[group](group, seed)
    with tempfile.TemporaryDirectory() as folder:
        found = adjust_case(case, Path(folder))
    camera, chosen = found.model.cameras[1], found.lenses[1].chosen
    family = FISHEYE if "FISHEYE" in camera.model.name else PERSPECTIVE
    expected = FISHEYE if group == "fisheye" else PERSPECTIVE
    terms = {part.name: len(part.places) for part in PARTS[family] if part.name not in ("center", "aspect")}
    needless = sum(terms.get(name, 0) for name in set(chosen.free) - set(case.true))
    true = case.drawn.camera
    focal = float(np.sqrt(camera.params[0] * camera.params[1]))

    def projected(rays: FloatArray) -> FloatArray:
        return np.asarray(camera.img_from_cam(rays, False), np.float64)

    row: Row = {
        "method": "adjust", "group": group, "seed": seed, "lens": case.lens, "chosen": chosen.model,
        "free": " ".join(chosen.free), "file": camera.model.name,
        "right": int(family == expected and chosen.model == model_name(expected, case.true)) if case.exact else None,
        "needless": needless, "focal %": 100.0 * abs(focal / true.K[0, 0] - 1.0),
        "radius %": radius_error_percent(true, projected, camera.params[2:4], shown_reach(case)),
        "rival": found.lenses[1].rivals[0].model, "lost": round(found.lenses[1].rivals[0].log_evidence, 2),
    }  # fmt: skip
    return row | (held_out_row(found.model, family, chosen.free, seed) if hold_out else {})


def shown_reach(case: Case) -> float:
    """Return the radius up to which a camera is measured: that of the outermost keypoints, in pixels."""
    x = np.concatenate(list(case.drawn.x.values()))
    return float(np.quantile(np.hypot(*(x - case.drawn.camera.K[:2, 2]).T), 0.999))


def held_out_row(model: pycolmap.Reconstruction, family: int, free: tuple[str, ...], seed: int) -> Row:
    """Return which model explains held-out observations best, and how much worse the chosen one does."""
    ids, bundle = read_bundle(model)
    names = [part.name for part in PARTS[family]]
    kept = tuple(name for name in free if name in ("center", "aspect"))
    bent = tuple(name for name in free if name not in kept)
    likelihoods = {}
    for parts in dict.fromkeys([*RIVALS[family], bent]):
        choice = np.array([[name in (*kept, *parts) for name in names]])
        likelihoods[parts] = held_out_likelihoods(model, ids, bundle, choice, seed)
    best = max(likelihoods, key=lambda parts: float(likelihoods[parts].sum()))
    below = float((likelihoods[best] - likelihoods[bent]).sum())
    return {"best held out": " ".join(best), "below": round(below, 3)}


def held_out_likelihoods(
    model: pycolmap.Reconstruction, ids: list[int], bundle: Bundle, choice: NDArray[np.bool_], seed: int
) -> FloatArray:
    """Return the log-likelihoods of a fifth of the observations after a refit to the others with these parts freed."""
    out = np.random.default_rng(seed).integers(FOLDS, size=len(bundle.x)) == 0
    out &= np.bincount(bundle.point[~out], minlength=len(bundle.X))[bundle.point] >= 2
    train = replace(bundle, photo=bundle.photo[~out], point=bundle.point[~out], x=bundle.x[~out])
    noise_px, scale_px = [], bundle_scale(bundle)
    for _ in range(REFITS):
        reduced = reduce(train, scale_px)
        noise_px.append(reduced.noise_px)
        priors = replace(lens_priors(model, ids, train), choices=(choice,))
        train = best_step(train, reduced, estimate_lenses(train.params, reduced, priors).params, scale_px)
    test = replace(train, photo=bundle.photo[out], point=bundle.point[out], x=bundle.x[out])
    r2 = np.sum(residuals(test, project(test)[0]) ** 2, axis=1)
    # the first step's noise is that of the adjusted bundle, the same for all that are compared
    losses = 0.5 * (scale_px / noise_px[0]) ** 2 * np.log1p(r2 / scale_px**2)
    return np.asarray(-losses, np.float64)


def summarize(rows: Sequence[Row]) -> Iterator[Row]:
    """Yield a row for each group, and for each lens in it."""
    for group in dict.fromkeys(row["group"] for row in rows):
        own = [row for row in rows if row["group"] == group]
        for lens in ["all", *sorted({row["lens"] for row in own})]:
            some = [row for row in own if lens in ("all", row["lens"])]
            right = [row["right"] for row in some if row["right"] is not None]
            asked = [row["below"] for row in some if "below" in row]
            files = sorted({row["file"] for row in some})
            yield {
                "group": group, "lens": lens, "bundles": len(some),
                "right %": round(100.0 * float(np.mean(right)), 1) if right else None,
                "most needless": max(row["needless"] for row in some),
                "focal % median": round(float(np.median([row["focal %"] for row in some])), 4),
                "focal % worst": round(max(row["focal %"] for row in some), 4),
                "radius % worst": round(max(row["radius %"] for row in some), 4),
                "held-out %": round(100.0 * float(np.mean(np.array(asked) <= np.log(STRONG))), 1) if asked else None,
                "file models": ", ".join(files),
            }  # fmt: skip


def parser() -> argparse.ArgumentParser:
    """Give the command line."""
    parser = new_parser("lenses.models", __doc__)
    add_seeds(parser, 100, "lens-models")
    parser.add_argument("--groups", nargs="+", default=list(GROUPS), choices=GROUPS)
    parser.add_argument("--hold-out", type=int, default=20, help="bundles of each group with held-out observations")
    return parser


def main() -> None:
    """Run all bundles and publish."""
    args = parser().parse_args()
    show_log(0)
    rows: list[Row] = []
    for group in args.groups:
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            rows.append(measure(group, seed, hold_out=seed - args.first_seed < args.hold_out))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    page = f"# Camera models\n\n{ABOUT}\n\n{table([dict(row) for row in summarize(rows)], COLUMNS)}"
    options = {"seeds": args.seeds, "first seed": args.first_seed, "groups": args.groups, "hold out": args.hold_out}
    write(args.results, args.name, document("lenses.models", ABOUT, options, {}, rows), page)
    print(page)


if __name__ == "__main__":
    main()
