"""scene: ViewGraph and Intrinsics -> Scene."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm_app.colmap.backend import backend
from sfm_app.colmap.bundle import adjust
from sfm_app.colmap.mapping import PhotoCounter, continue_mapping
from sfm_app.colmap.model import model_from_seed, read_scene, turn_upright
from sfm_app.context import RunContext
from sfm_app.diagnosis import why_no_depth, why_no_scene
from sfm_app.geometry.camera import rays
from sfm_app.geometry.epipolar import eight_point
from sfm_app.geometry.seed import TwoViewSeed, two_view_seed
from sfm_app.ransac.refit import refine_sampson
from sfm_app.types import Calibration, EpipolarFit, Intrinsics, MatchGraph, PairId, PhotoSet, Scene, ViewGraph

RANKED_PAIRS = 60
"""Pairs with most inliers that are looked at as seeds."""

ENOUGH = 0.9
"""A model with this share of the photos that hang together with its seed ends the search for a better seed."""

DISSENT = 0.1
"""What counts of a seed whose pair contradicts the camera matrix that other pairs agree on."""

CONFIRMED = 0.5
"""So does this share when two seeds agree on how many photos can be placed."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pair of photos that mapping may start from."""

    pair: PairId
    fit: EpipolarFit
    seed: TwoViewSeed
    score: float
    """What the seed promises, times how well the pair agrees with K."""


def reconstruct_scene(matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics, run: RunContext) -> Scene:
    """Start mapping from our own pose and points of the best pair; when it fails, from the next best.

    Raises:
        ReconstructionError: no seed grows into a model; says what was seen.
    """
    candidates = rank_seeds(matches, views, intrinsics, run)
    best, tried = best_model(candidates, matches, views, run)
    if best is None:
        details = "; ".join(tried) or "no pair has parallax enough to start from"
        raise why_no_scene(matches, views, run.settings.matching).error(details)
    placed = {image.image_id for image in best.images.values() if image.has_pose}
    known = all(intrinsics.camera(matches.images[key]).method != "guess" for key in placed)
    doubt = why_no_depth(matches, views, placed, run.settings.epipolar, camera_known=known)
    if doubt:
        raise doubt.error()
    with backend("adjusting the bundle"):
        best, deviations = adjust(best, run.workspace.database)
        turn_upright(best)
    write_model(best, run)
    names = {image.name: intrinsics.name_of(image) for image in matches.images.values()}
    scene = read_scene(run.workspace.sparse, names, left_out(best, matches, views))
    run.record(
        registered=len(scene.registered),
        of=len(matches.images),
        unregistered=dict(scene.unregistered),
        points=scene.points,
        observations=scene.observations,
        mean_reprojection_px=round(scene.mean_reprojection_px, 4),
        cameras={name: {"model": camera.model, "params": camera.params} for name, camera in scene.cameras.items()},
        deviations_px={name: round(value, 4) for name, value in deviations.items()},
        seeds_tried=tried,
    )
    return scene


def rank_seeds(matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics, run: RunContext) -> list[Candidate]:
    """Pairs that can start a mapping, best first: many points, wide angle, nothing degenerate, in accord with K."""

    def examine(pair: PairId) -> Candidate:
        cameras = [intrinsics.camera(matches.images[key]) for key in pair]
        seed = seed_of(matches, views.fits[pair], pair, cameras)
        return Candidate(pair, views.fits[pair], seed, seed.score * agreement(pair, cameras))

    firm = [pair for pair, fit in views.fits.items() if not fit.degeneracy] or list(views.fits)
    firm.sort(key=lambda pair: (-views.fits[pair].inlier_count, pair))
    found = run.map(examine, firm[:RANKED_PAIRS], "seed pairs")
    least = run.settings.scene.min_seed_angle_deg
    wide = [candidate for candidate in found if candidate.seed.angle_deg >= least and candidate.seed.usable.sum() >= 8]
    return sorted(wide, key=lambda candidate: (-candidate.score, candidate.pair))


def seed_of(matches: MatchGraph, fit: EpipolarFit, pair: PairId, cameras: Sequence[Calibration]) -> TwoViewSeed:
    """Pose and points of a pair; where there is a lens, from its inliers as they were without it."""
    first, second = cameras
    x1, x2 = (
        rays(x[fit.inliers], camera.K, camera.radial) for x, camera in zip(matches.points(pair), cameras, strict=True)
    )
    E = second.K.T @ fit.F @ first.K
    if first.radial or second.radial:
        E = refine_sampson(np.asfortranarray(np.hstack([x1, x2])), eight_point(x1, x2))
    return two_view_seed(E, x1, x2)


def agreement(pair: PairId, cameras: Sequence[Calibration]) -> float:
    """1 for a pair that agrees with the camera its consensus found, little for one that does not."""
    first, second = cameras
    unknown = first is not second or not first.key_pairs
    return 1.0 if unknown or pair in first.key_pairs else DISSENT


def best_model(
    candidates: list[Candidate], matches: MatchGraph, views: ViewGraph, run: RunContext
) -> tuple[Any | None, list[str]]:
    """The model with most photos that the best seeds grow into, and what each of them gave."""
    tried: list[str] = []
    best, most = None, 0
    for candidate in candidates[: run.settings.scene.seed_pairs]:
        model = grow(candidate, matches, run)
        found = model.num_reg_images() if model else 0
        tried.append(f"{_names(candidate.pair, matches)}: {found} photos")
        reachable = len(connected(candidate.pair, views))
        agreed = found == most and found >= CONFIRMED * reachable
        if found > most:
            best, most = model, found
        if agreed or found >= ENOUGH * reachable:
            break
    return best, tried


def grow(candidate: Candidate, matches: MatchGraph, run: RunContext) -> Any | None:
    """Map on from one seed; None when the model stays without enough points."""
    place = run.workspace
    with backend("mapping photos"):
        rows = matches.matches[candidate.pair][candidate.fit.inliers]
        start = model_from_seed(place.database, candidate.pair, rows, candidate.seed)
        counter = PhotoCounter(run.progress, len(matches.images))
        try:
            scratch = place.root / ".mapping"
            model = continue_mapping(place.database, place.photos, start, scratch, run.seed, counter)
        finally:
            run.progress.finish()
    enough = model is not None and model.num_points3D() >= run.settings.scene.min_points and model.num_reg_images() > 1
    return model if enough else None


def connected(pair: PairId, views: ViewGraph) -> set[int]:
    """Ids of all photos that hang together with a pair through accepted pairs."""
    reached = set(pair)
    while True:
        more = {key for edge in views.fits for key in edge if not reached.isdisjoint(edge)} - reached
        if not more:
            return reached
        reached |= more


def left_out(model: Any, matches: MatchGraph, views: ViewGraph) -> dict[str, str]:
    """Why each photo without a pose has none."""
    posed = {image.image_id for image in model.images.values() if image.has_pose}
    return {image.name: _reason(image.id, posed, views) for image in matches.images.values() if image.id not in posed}


def write_model(model: Any, run: RunContext) -> None:
    """Put the model into OUT/sparse as a whole."""
    target = run.workspace.sparse
    beside = target.with_name(".sparse")
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir()
    with backend("writing the sparse model"):
        model.write(beside)
    shutil.rmtree(target, ignore_errors=True)
    beside.rename(target)


def load_scene(photos: PhotoSet, intrinsics: Intrinsics, run: RunContext) -> Scene:
    """Read the model back; why photos were left out stands in the manifest."""
    record = run.workspace.record("scene")
    names = {photo.name: intrinsics.name_of(photo) for photo in photos.photos}
    with backend("reading the sparse model"):
        unregistered = record.counts.get("unregistered", {}) if record else {}
        return read_scene(run.workspace.sparse, names, unregistered)


def _names(pair: PairId, matches: MatchGraph) -> str:
    return " + ".join(matches.images[key].name for key in pair)


def _reason(image_id: int, posed: set[int], views: ViewGraph) -> str:
    edges = list(_edges(image_id, views))
    to_posed = [count for other, count in edges if other in posed]
    if to_posed:
        return f"could not be placed: at most {max(to_posed)} inliers with a photo that was"
    if edges:
        return "shares inliers only with photos that have no place either"
    return "shares no scene with any other photo"


def _edges(image_id: int, views: ViewGraph) -> Iterator[tuple[int, int]]:
    for pair, fit in views.fits.items():
        if image_id in pair:
            yield pair[pair[0] == image_id], int(np.count_nonzero(fit.inliers))
