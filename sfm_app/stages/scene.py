"""scene: ViewGraph and Intrinsics -> Scene."""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sfm_app.atomic_io import can_go_on, mark_unfinished, replacing
from sfm_app.colmap.backend import backend, check_written
from sfm_app.colmap.bundle import Adjusted, adjusted_or_as_it_was
from sfm_app.colmap.model import Refined, color, photos_of, posed_images, read_scene, sparse_model
from sfm_app.colmap.types import Reconstruction
from sfm_app.errors import ReconstructionError
from sfm_app.estimation.diagnosis import why_no_depth, why_no_scene
from sfm_app.hashing import digest_files
from sfm_app.numerical import Json, json_text
from sfm_app.reconstruction import Found, Outcome, look_again, reconstruct
from sfm_app.reconstruction.align_upright import look_at_photos, orient_or_leave
from sfm_app.reconstruction.look_alikes import in_words, jumps
from sfm_app.reconstruction.unregistered import left_out, names_of
from sfm_app.reconstruction.weak_scale import weakly_joined
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import MAPPING, Aside, Workspace
from sfm_app.types import Intrinsics, MatchGraph, Scene, ViewGraph

POINTS = "points"
"""Name of the files with the points and cameras."""


def make(matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics, run: RunContext) -> Scene:
    """Map the photos and adjust everything; later stages use the largest model, the others are kept beside it.

    Args:
        matches: keypoints and raw matches.
        views: fundamental matrices.
        intrinsics: cameras from pairs.
        run: the run.

    Raises:
        ReconstructionError: no pair of photos grows into a model; the message says why.
    """
    aside = mapping_run(run)
    first = Found(reconstruct(matches, views, intrinsics, aside), matches, views, intrinsics, aside)
    try:
        scene = _adjusted_scene(look_again(first), run)
    except ReconstructionError:  # after any other end, such as Ctrl-C or a full disk, the same command resumes there
        shutil.rmtree(aside.workspace.root, ignore_errors=True)
        raise
    shutil.rmtree(aside.workspace.root, ignore_errors=True)
    return scene


def load(run: RunContext) -> Scene:
    """Read the model and scene.json back."""
    place = run.workspace
    known = json.loads(place.scene.read_text(encoding="utf-8"))
    with backend("reading the sparse model"):
        return read_scene(place.sparse, known["camera_of"], known["unregistered"], known["cameras"])


def digest(place: Workspace) -> str:
    """Return a hash of the model and scene.json."""
    return digest_files(place.root, place.sparse.name, place.scene.name)


def mapping_run(run: RunContext) -> RunContext:
    """Return the run in an inner folder, where mapping has its own database and a killed run can resume."""
    place = Aside(run.workspace, MAPPING)
    if not can_go_on(place.root, run.fingerprint):
        mark_unfinished(place.root, run.fingerprint)
    return replace(run, workspace=place)


def _adjusted_scene(found: Found, run: RunContext) -> Scene:
    """Adjust the models, orient them upright, write them and record their figures.

    Raises:
        ReconstructionError: no model has depth.
    """
    matches, views, intrinsics = found.matches, found.views, found.intrinsics
    outcome = _with_depth(found.outcome, matches, views, intrinsics, run)
    looks = look_at_photos([attempt.model for attempt in outcome.models], matches, run)
    adjusted = [adjusted_or_as_it_was(attempt.model, found.run.workspace.database) for attempt in outcome.models]
    models = [found.model for found in adjusted]
    with backend("reading colors"):
        for model in models:
            color(model, run.workspace.photos, run.workers)
    turn_deg = None if run.settings.scene.photo_rotation_deg == "auto" else run.settings.scene.photo_rotation_deg
    orientations = [orient_or_leave(model, matches, looks, turn_deg) for model in models]
    write_models(models, run)
    run.write_model(sparse_model(run.workspace.sparse), POINTS)
    members = [photos_of(model) for model in models]
    reasons = left_out(set(members[0]), members[1:], matches, views, outcome.graph)
    names = {image.name: outcome.intrinsics.name_of(image) for image in matches.images.values()}
    scene = read_scene(run.workspace.sparse, names, reasons, refined_by_name(adjusted[0], names))
    write_scene(scene, run)
    run.record(
        registered=len(scene.registered),
        of=len(matches.images),
        unregistered=dict(scene.unregistered),
        other_models=[names_of(photos, matches) for photos in members[1:]],
        points=scene.points,
        observations=scene.observations,
        mean_reprojection_px=round(scene.mean_reprojection_px, 4),
        orientation=orientations[0],
        adjustment=_how_it_was_adjusted(adjusted, names),
        **how_it_was_made(outcome),
        look_alikes=in_words(outcome.graph.look_alikes, matches),
        perhaps_look_alikes=in_words(outcome.graph.doubtful, matches),
        jumps=jumps(models[0]),
        weakly_joined=weakly_joined(models[0]),
    )
    return scene


def _with_depth(
    outcome: Outcome, matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics, run: RunContext
) -> Outcome:
    """Drop the models of photos without parallax: their shape is arbitrary.

    Raises:
        ReconstructionError: no model is left; the message says why.
    """
    kept, doubts = [], []
    for attempt in outcome.models:
        placed = set(photos_of(attempt.model))
        known = all(intrinsics.camera(matches.images[photo]).method != "guess" for photo in placed)
        doubt = why_no_depth(matches, views, placed, run.settings.epipolar, camera_known=known)
        if doubt:
            doubts.append(doubt)
        else:
            kept.append(attempt)
    if doubts and not kept:
        raise doubts[0].error()
    if not kept:
        raise why_no_scene(matches, views, run.settings.matching).error("; ".join(outcome.tried))
    return replace(outcome, models=tuple(kept))


def how_it_was_made(outcome: Outcome) -> dict[str, Json]:
    """Return the manifest's figures about relative poses and mapping."""
    poses, main = outcome.graph.poses.values(), outcome.models[0]
    dropped = list(outcome.graph.dropped.values())
    kinds = [pose.kind for pose in poses]
    return {
        "mapper": main.mapper,
        "mapper_reason": outcome.reason,
        "tried": list(outcome.tried),
        "passes": outcome.passes,
        "one_camera_each": outcome.one_camera_each,
        "rival_tried_because": outcome.thin,
        "explained_matches": sum(pair.matches for pair in main.explained.values()),
        "contradicted_matches": sum(pair.contradicted for pair in main.explained.values()),
        "cut_apart": list(outcome.cuts),
        "pairs": {kind: kinds.count(kind) for kind in sorted(set(kinds))}
        | {"found with the help of others": sum(pose.guided for pose in poses)},
        "pairs_dropped": {reason: dropped.count(reason) for reason in sorted(set(dropped))},
    }


def _how_it_was_adjusted(adjusted: Sequence[Adjusted], names: Mapping[str, str]) -> dict[str, Json]:
    """Return the manifest's entries about problems of the last adjustment; empty for none."""
    main, others = adjusted[0], adjusted[1:]
    cameras = {image.camera_id: names[image.name] for image in posed_images(main.model)}
    found: dict[str, Json] = {
        "failed": main.trouble,
        "failed_in_other_models": {str(number): one.trouble for number, one in enumerate(others, 1) if one.trouble},
        "cameras_held": [cameras[camera_id] for camera_id in main.held],
        "points_left_open": main.open_points,
    }
    return {key: value for key, value in found.items() if value}


def write_models(models: list[Reconstruction], run: RunContext) -> None:
    """Write the main model to OUT/sparse and the others to OUT/other_models/1, 2, ..., each as a whole.

    Args:
        models: the main one first; at least one.
        run: the run.
    """
    place = run.workspace
    shutil.rmtree(place.other_models, ignore_errors=True)
    for number, model in enumerate(models[1:], start=1):
        write_model(model, place.other_models / str(number))
    write_model(models[0], place.sparse)


def write_model(model: Reconstruction, target: Path) -> None:
    """Write a model into a folder beside the target, then replace the target with it.

    Args:
        model: COLMAP's reconstruction.
        target: folder, replaced if it exists.
    """
    beside = target.with_name(f".{target.name}")
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir(parents=True)
    with backend("writing the sparse model"):
        model.write(beside)
        check_written(*beside.iterdir())
    shutil.rmtree(target, ignore_errors=True)
    beside.rename(target)


def refined_by_name(adjusted: Adjusted, names: Mapping[str, str]) -> dict[str, Refined]:
    """Return deviations and determined parameters of the refined cameras, by name of the camera.

    Args:
        adjusted: the model with the deviations of its cameras.
        names: camera of each photo, by photo name.
    """
    cameras = {names[image.name]: image.camera_id for image in posed_images(adjusted.model)}
    return {
        name: {"deviations": adjusted.deviations[camera_id], "determined": adjusted.determined[camera_id]}
        for name, camera_id in cameras.items()
    }


def write_scene(scene: Scene, run: RunContext) -> None:
    """Write scene.json: what COLMAP's model does not hold.

    Args:
        scene: the scene.
        run: the run.
    """
    known = {
        "cameras": {name: camera.to_dict() for name, camera in scene.cameras.items()},
        "camera_of": dict(scene.camera_of),
        "unregistered": dict(scene.unregistered),
    }
    with replacing(run.workspace.scene) as path:
        path.write_text(json_text(known), encoding="utf-8")
