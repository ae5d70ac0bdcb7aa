"""Scores of a run on a set of the corpus: camera errors in stated deviations, walks, and warnings of folds."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.cameras.score import PARAMETER_ENTRIES, Model, TruePhoto, read_models
from benchmarks.common.outputs import read_initial_cameras, read_refined_cameras
from benchmarks.common.results import Row
from benchmarks.corpus.trajectory import offset_errors, order_scores

WALKS = ("oats23", "books21")
"""Sets whose truth is the order of the photos."""
OFFSETS = ("kitchen1000",)
"""Sets whose truth is the poses of another camera on the same rig, and no K."""
PARAMETERS = ("fx", "fy", "cx", "cy")
FAR_SD = 3.0
"""A parameter that is off by more stated deviations is a miss."""
FAR_PERCENT = 3.0
"""A focal that is called identifiable and is off by more is confidently wrong."""
FOLD_WORDS = re.compile(r"fold|alike|beware|jump", re.IGNORECASE)
"""Words of a sentence about look-alike places."""
WARNING_WORDS = re.compile(r"fold|beware", re.IGNORECASE)
"""Words of a sentence that warns of a wrong model; "look-alikes told apart" is no such warning."""


class Doubt(NamedTuple):
    """Uncertainty of the truth itself, from its source: one standard deviation, in percent."""

    focal: float
    center: float
    """In percent of the width."""


DOUBTS: Mapping[str, Doubt] = {
    "fox50": Doubt(1.0, 1.0),
    "lund-door12": Doubt(1.5, 1.0),
    "merton1": Doubt(1.7, 0.9),
    "reichstag10": Doubt(1.5, 2.0),
}
"""COLMAP models (center held fixed, or known to a percent), and three views whose K differ by a few percent."""


def parameter_errors(out: Path, truth: Mapping[str, TruePhoto], doubt: Doubt) -> list[Row]:
    """List every parameter of every camera that the program states: estimate, truth, and error in deviations.

    Before adjustment only cameras that are called identifiable count; the others are declared guesses. A camera's
    truth is the median over its photos.
    """
    rows = []
    for stage in _stages(out):
        photos = [Path(photo).stem for photo in stage.photos if Path(photo).stem in truth]
        if photos:
            true = np.median([truth[photo].K for photo in photos], axis=0)
            width = float(np.median([truth[photo].width for photo in photos]))
            about = {"camera": stage.camera, "its photos": len(photos)}
            rows += [about | row for row in _stage_errors(stage, true, width, doubt)]
    return rows


class Stage(NamedTuple):
    """The stated parameters of a camera before or after bundle adjustment."""

    camera: str
    photos: tuple[str, ...]
    when: str
    K: NDArray[np.float64]
    deviations: Mapping[str, float]
    identifiable: bool


def _stages(out: Path) -> Iterator[Stage]:
    """Yield every camera before adjustment, and after it, where mapping may have split it."""
    cameras, camera_of = read_initial_cameras(out)
    for name, photos in _photos_by_camera(camera_of).items():
        before = cameras[name]
        if before["identifiable"]:
            yield Stage(name, photos, "before", np.array(before["K"]), before.get("spread", {}), identifiable=True)
    cameras, camera_of = read_refined_cameras(out)
    for name, photos in _photos_by_camera(camera_of).items():
        K, deviations = np.array(cameras[name]["K"]), cameras[name].get("deviations", {})
        yield Stage(name, photos, "after", K, deviations, identifiable=_is_focal_claimed(K, deviations))


def _photos_by_camera(camera_of: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Group the photos by camera."""
    return {name: tuple(photo for photo in camera_of if camera_of[photo] == name) for name in camera_of.values()}


def _is_focal_claimed(K: NDArray[np.float64], deviations: Mapping[str, float]) -> bool:
    """Return whether bundle adjustment claims focals within `FAR_PERCENT`: three deviations of each are no more."""
    stated = [(K[PARAMETER_ENTRIES[name][0]], deviations.get(name, deviations.get("f"))) for name in ("fx", "fy")]
    return all(sd is not None and 0 < FAR_SD * sd <= FAR_PERCENT / 100 * focal for focal, sd in stated)


def _stage_errors(stage: Stage, true: NDArray[np.float64], width: float, doubt: Doubt) -> Iterator[Row]:
    for name in PARAMETERS:
        (place,) = PARAMETER_ENTRIES[name]
        focal = name in ("fx", "fy")
        whole = float(true[place]) if focal else width
        error, sd = abs(float(stage.K[place] - true[place])), stage.deviations.get(name, stage.deviations.get("f"))
        unsure = (doubt.focal if focal else doubt.center) / 100 * whole
        known = sd if sd is not None and math.isfinite(sd) and sd > 0 else None
        yield {
            "when": stage.when,
            "parameter": name,
            "identifiable": "yes" if stage.identifiable else "no",
            "found": round(float(stage.K[place]), 2),
            "true": round(float(true[place]), 2),
            "sd": round(float(known), 3) if known else None,
            "error %": round(100 * error / whole, 3),
            "in sd": round(error / known, 2) if known else None,
            "in sd, truth's doubt granted": round(error / math.hypot(known, unsure), 2) if known else None,
        }


def parameter_summary(rows: Sequence[Row]) -> Row:
    """Summarize the parameters of a run."""
    row: Row = {}
    for when in ("before", "after"):
        stated = [one for one in rows if one["when"] == when and one["in sd"] is not None]
        row[f"worst in sd {when}"] = max((one["in sd"] for one in stated), default=None)
        for name in PARAMETERS:
            of_name = [one for one in rows if one["when"] == when and one["parameter"] == name]
            if of_name:
                worst = max(of_name, key=lambda one: one["error %"])
                row |= {f"{name} % {when}": worst["error %"], f"sd {name} {when}": worst["sd"]}
    return row


def parameter_counts(rows: Sequence[Row]) -> Row:
    """Count the stated parameters, those that are far off, and the focals that are confidently wrong."""
    stated = [row for row in rows if row["in sd"] is not None]
    focals = [row for row in rows if row["parameter"] in ("fx", "fy") and row["identifiable"] == "yes"]
    granted = "in sd, truth's doubt granted"
    return {
        "stated": len(stated),
        "beyond 3 sd": sum(row["in sd"] > FAR_SD for row in stated),
        "beyond 3 sd, truth's doubt granted": sum(row[granted] > FAR_SD for row in stated),
        "focals called identifiable": len(focals),
        "of them over 3 % off": sum(row["error %"] > FAR_PERCENT for row in focals),
    }


def claimed_errors(rows: Sequence[Row]) -> Row:
    """Return the errors of what is called identifiable before adjustment (else 0), and f in the bounds of kitti51."""
    before = [row for row in rows if row["when"] == "before"]
    after = [row for row in rows if row["when"] == "after" and row["parameter"] in ("fx", "fy")]
    row: Row = {
        "claimed focal %": max((one["error %"] for one in before if one["parameter"] in ("fx", "fy")), default=0.0),
        "claimed center %": max((one["error %"] for one in before if one["parameter"] in ("cx", "cy")), default=0.0),
    }
    if after:
        shares = [min(one["error %"] / FAR_PERCENT, (one["in sd"] or math.inf) / FAR_SD) for one in after]
        row["focal of 3 % or 3 sd"] = round(max(shares), 3)
    return row


def walk_figures(models: Sequence[Model], said: Sequence[str]) -> Row:
    """Score the order of the photos in each model, and check whether a fold is reported."""
    orders = [order for order in (order_scores(model.poses) for model in models) if order is not None]
    if not orders:
        return {}
    row: Row = {
        "axis": round(orders[0].axis, 3),
        "distance": round(orders[0].distance, 3),
        "jumps": orders[0].jumps,
        "axis of the worst part": round(min(order.axis for order in orders), 3),
        "distance of the worst part": round(min(order.distance for order in orders), 3),
    }
    return row | {"warned of folds": "yes" if any(map(WARNING_WORDS.search, said)) else "no"}


def offset_figures(models: Sequence[Model], truth: Mapping[str, TruePhoto]) -> Row:
    """Return the errors against a camera fixed beside ours."""
    poses = {name: photo.pose for name, photo in truth.items()}
    found = offset_errors(models[0].poses, poses) if models else None
    if found is None:
        return {}
    return {
        "median center cm": round(100 * float(np.median(found.center)), 2),
        "90 % center cm": round(100 * float(np.percentile(found.center, 90)), 2),
        "median rotation deg": round(float(np.median(found.rotation_deg)), 2),
    }


def fold_lines(said: Sequence[str]) -> list[str]:
    """List the lines in which a run mentions look-alike places."""
    return [line.strip() for line in said if FOLD_WORDS.search(line)]


def corpus_figures(name: str, out: Path, truth: Mapping[str, TruePhoto], said: Sequence[str]) -> tuple[Row, list[Row]]:
    """Return the corpus figures that the cameras' table lacks, and the parameters one by one."""
    models = read_models(out)
    row: Row = {"of photos in models": sum(len(model.poses) for model in models)}
    stated: list[Row] = []
    if name in WALKS:
        row |= walk_figures(models, said)
    elif name in OFFSETS:
        row |= offset_figures(models, truth)
    elif truth:
        stated = parameter_errors(out, truth, DOUBTS.get(name, Doubt(0.0, 0.0)))
        row |= parameter_summary(stated) | claimed_errors(stated)
    return row, stated
