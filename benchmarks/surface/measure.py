"""Scores of one photo set: cost, file sizes, distance to the truth, similarity to the photos."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from benchmarks.common.results import Row
from benchmarks.surface.depth_camera.kinect import KinectTruth, kinect_scores
from benchmarks.surface.left_out import remake_without
from benchmarks.surface.photos import (
    Likeness,
    likeness,
    photo_scores,
    placed_photo,
    placed_photos,
    render_view,
    subsample,
)  # fmt: skip
from benchmarks.surface.rendered.detail import detail_scores
from benchmarks.surface.rendered.truth import seen_places, truth_scores
from benchmarks.surface.sets import dense_stages
from benchmarks.surface.sparse_poisson import sparse_surfaces
from benchmarks.surface.worker import StageCost
from sfm_app.errors import SfmError
from sfm_app.synthetic.photo_folder import Truth
from sfm_app.synthetic.render import PreparedModel
from sfm_app.synthetic.shapes import SyntheticScene
from sfm_app.types import Surface

FILES = ("glb", "ply", "obj")


def cost(said: Mapping[str, StageCost]) -> Row:
    """Return seconds and memory of the stages after the cameras, and the reason if one failed."""
    failed = next((one.failed for one in said.values() if one.failed), "")
    row: Row = {"failed": failed, "seconds together": None}
    for stage in dense_stages():
        if stage in said:
            row |= {f"s of {stage}": said[stage].seconds, f"MB {stage}": said[stage].peak_mb}
    if not failed:
        timed = [said[stage].seconds or 0.0 for stage in dense_stages() if stage != "files"]
        row["seconds together"] = round(sum(timed), 1)
    return row


def file_sizes(out: Path) -> Row:
    """Return the sizes of the model files in kB."""
    found = {suffix: out / f"model.{suffix}" for suffix in FILES}
    return {f"kB {suffix}": path.stat().st_size // 1000 for suffix, path in found.items() if path.exists()}


def compare_with_truth(surface: Surface, out: Path, truth: Truth, scene: SyntheticScene) -> Row:
    """Score our surface, and the best one from the sparse points, against the truth of a scene."""
    centers = {name: image.projection_center() for name, image in placed_photos(out).items()}
    seen = seen_places(truth)
    row = truth_scores(surface, centers, truth, seen)
    row["completeness of 3 photos %"] = truth_scores(surface, centers, truth, seen_places(truth, 3))["completeness %"]
    row |= detail_scores(surface, centers, truth, scene)
    rivals = [
        truth_scores(found, centers, truth, seen) | {"trim": trim}
        for trim, found in sparse_surfaces(out / "sparse")
        if len(found.faces)
    ]
    best = max(rivals, key=lambda rival: rival["F %"], default={})
    return row | {f"sparse: {name}": value for name, value in best.items()}


def compare_with_kinect(surface: Surface, out: Path, truth: KinectTruth) -> Row:
    """Score our surface against what a depth camera saw."""
    poses = {Path(name).stem: np.asarray(image.cam_from_world().matrix()) for name, image in placed_photos(out).items()}
    return kinect_scores(surface, poses, truth)


def compare_with_photos(model: PreparedModel, out: Path, names: Sequence[str]) -> Row:
    """Average the scores over all registered photos."""
    return photo_scores(likenesses(model, out, names))


def likenesses(model: PreparedModel, out: Path, names: Sequence[str]) -> dict[str, Likeness]:
    """Compare the rendered model with each photo, by photo name."""
    found = {}
    for name in names:
        photo = placed_photo(out, name)
        found[name] = likeness(render_view(model, photo), photo.pixels)
    return found


def score_left_out(
    out: Path, model: PreparedModel, settings: Mapping[str, Any], *, count: int, geometry_too: bool
) -> Row:
    """Return PSNR in photos that the texture was made without, and by how much it is lower than with them."""
    names = subsample(list(placed_photos(out)), count)
    with_it = likenesses(model, out, names)
    values, lower = [], []
    for name in names:
        target = out.with_name(f"{out.name}-left-out")
        try:
            without = PreparedModel(remake_without(out, target, name, settings, geometry_too=geometry_too))
        except SfmError as error:
            return {"left out": f"without {name}: {error}"}
        psnr = likenesses(without, out, [name])[name].psnr_db
        if math.isfinite(psnr) and math.isfinite(with_it[name].psnr_db):
            values.append(psnr)
            lower.append(with_it[name].psnr_db - psnr)
    if not values:
        return {"left out": "no photo is covered enough"}
    return {
        "left out": f"{len(values)} of {len(placed_photos(out))}",
        "left out: PSNR dB": round(fmean(values), 2),
        "left out: PSNR lower by dB": round(fmean(lower), 2),
    }
