"""scene: ViewGraph and Intrinsics -> Scene."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.bundle import Adjustment, adjust_or_keep
from sfm_app.colmap.model import color_points, posed_images, posed_photo_ids, read_scene
from sfm_app.errors import ReconstructionError
from sfm_app.estimation.claims import camera_rules, refined_claims, report_claims
from sfm_app.estimation.diagnosis import diagnose_depth, diagnose_scene
from sfm_app.estimation.given_cameras import given_and_found, report_checks
from sfm_app.files import mark_unfinished, resume_or_clear
from sfm_app.frame.upright import gps_deviation, gps_place, orient_or_keep, submit_cue_extraction
from sfm_app.mapping.attempt import unregistered_reasons
from sfm_app.mapping.hypotheses import reconstruct
from sfm_app.mapping.look_alikes import jumps, look_alike_entries
from sfm_app.mapping.new_photos import GROWN, map_new_photos
from sfm_app.mapping.passes import MISPLACED, Outcome, without_misplaced
from sfm_app.mapping.rolling_shutter import follow_shutter
from sfm_app.mapping.splits import weakly_joined_parts
from sfm_app.numerical import Json
from sfm_app.products import write_scene, write_sparse_models
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import MAPPING, SubWorkspace
from sfm_app.types import Evidence, Intrinsics, MatchGraph, Scene, ViewGraph


def make(matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics, run: RunContext) -> Scene:
    """Map the photos and adjust everything; later stages use the largest model, the others are written beside it.

    If an earlier model covers most photos, the new ones are registered in it. Raise a ReconstructionError if no pair
    of photos grows into a model.
    """
    inner, evidence = mapping_run(run), Evidence(matches.with_priors(intrinsics.priors), views, intrinsics)
    outcome = reconstruct(evidence, inner) if run.earlier is None else map_new_photos(evidence, inner, run.earlier)
    try:
        scene = _finish_scene(outcome, run)
    except ReconstructionError:  # after other errors, such as Ctrl-C or a full disk, the same command resumes there
        shutil.rmtree(inner.workspace.root, ignore_errors=True)
        raise
    shutil.rmtree(inner.workspace.root, ignore_errors=True)
    return scene


def mapping_run(run: RunContext) -> RunContext:
    """Return the run in an inner folder, with a database of its own, where a killed run can resume."""
    place = SubWorkspace(run.workspace, MAPPING)
    if not resume_or_clear(place.root, run.fingerprint):
        mark_unfinished(place.root, run.fingerprint)
    return replace(run, workspace=place)


def _adjust_models(
    outcome: Outcome, names: Mapping[str, str], run: RunContext
) -> tuple[list[Adjustment], dict[str, Json]]:
    """Return the adjusted models, and the manifest's entry about the rolling shutter of the first, if it has one."""
    database, family = outcome.run.workspace.database, run.settings.scene.camera_model
    rules = [camera_rules(a.model, names, outcome.calibrated, outcome.evidence.matches, family) for a in outcome.models]
    tries = run.settings.scene.tries
    with run.step("adjusting all cameras"):
        adjusted = [
            adjust_or_keep(
                attempt.model, database, rule, families_known=attempt.mapper == GROWN or not tries("lens-families")
            )
            for attempt, rule in zip(outcome.models, rules, strict=True)
        ]
    if not tries("rolling-shutter"):
        return adjusted, {}
    followed = [
        follow_shutter(one, outcome.evidence.matches, database, run.progress, rule)
        for one, rule in zip(adjusted, rules, strict=True)
    ]
    readout = followed[0][1]
    return [one for one, _ in followed], {} if readout is None else {"shutter": readout.to_dict()}


def _finish_scene(outcome: Outcome, run: RunContext) -> Scene:
    outcome = _drop_models_without_depth(outcome, run)
    matches, views, intrinsics = outcome.evidence.matches, outcome.evidence.views, outcome.calibrated
    cues = submit_cue_extraction([attempt.model for attempt in outcome.models], matches, run)
    names = {image.name: outcome.evidence.camera_name(photo) for photo, image in matches.images.items()}
    adjusted, shutter = _adjust_models(outcome, names, run)
    placed = without_misplaced(outcome, [one.model for one in adjusted])
    main, kept = (set(posed_photo_ids(one.models[0].model)) for one in (outcome, placed))
    if placed is not outcome:
        outcome = placed
        run.progress.say("some photos contradict their places; adjusting again without them")
        adjusted, shutter = _adjust_models(outcome, names, run)
    models = [one.model for one in adjusted]
    with translate_errors("reading colors"):
        for model in models:
            color_points(model, run.workspace.photos, run.workers)
    turn_deg = None if run.settings.scene.photo_rotation_deg == "auto" else run.settings.scene.photo_rotation_deg
    orientations = [orient_or_keep(model, matches, cues, turn_deg) for model in models]
    write_sparse_models(models, run.workspace)
    members = [posed_photo_ids(model) for model in models]
    reasons = unregistered_reasons(set(members[0]), members[1:], matches, views, outcome.graph)
    reasons |= dict.fromkeys(matches.names(sorted(main - kept)), MISPLACED)
    ids = {names[image.name]: image.camera_id for image in posed_images(adjusted[0].model)}
    refined = {name: adjusted[0].refined[key] for name, key in ids.items()}
    scene = read_scene(run.workspace.sparse, names, reasons, refined)
    scene = replace(scene, gps_deviation=gps_deviation(orientations[0]), gps_place=gps_place(orientations[0]))
    write_scene(scene, run.workspace)
    lenses = {name: adjusted[0].lenses.get(key) for name, key in ids.items()}
    run.record(
        **shutter,
        registered=len(scene.registered),
        of=len(matches.images),
        unregistered=dict(scene.unregistered),
        other_models=[matches.names(photos) for photos in members[1:]],
        points=scene.points,
        observations=scene.observations,
        mean_reprojection_px=round(scene.mean_reprojection_px, 4),
        orientation=orientations[0],
        adjustment=_adjustment_problems(adjusted, names),
        lenses={name: lens.to_dict() for name, lens in lenses.items() if lens is not None},
        **mapping_figures(outcome),
        look_alikes=look_alike_entries(outcome.graph.look_alikes, matches),
        perhaps_look_alikes=look_alike_entries(outcome.graph.doubtful, matches),
        jumps=jumps(models[0]),
        weakly_joined=weakly_joined_parts(models[0]),
    )
    report_checks(given_and_found(adjusted[0], names, intrinsics), run)
    report_claims(refined_claims(scene, intrinsics, matches), run)
    return scene


def _drop_models_without_depth(outcome: Outcome, run: RunContext) -> Outcome:
    """Drop models of photos without parallax, whose shape is arbitrary; raise a ReconstructionError if none is left."""
    matches, views = outcome.evidence.matches, outcome.evidence.views
    models, diagnoses = [], []
    for attempt in outcome.models:
        posed = set(posed_photo_ids(attempt.model))
        known = all(outcome.calibrated.camera(matches.images[photo]).method != "guess" for photo in posed)
        diagnosis = diagnose_depth(matches, views, posed, run.settings.epipolar, camera_known=known)
        if diagnosis:
            diagnoses.append(diagnosis)
        else:
            models.append(attempt)
    if diagnoses and not models:
        raise diagnoses[0].error()
    if not models:
        tried = "; ".join(note for trial in outcome.trials for note in trial.notes)
        raise diagnose_scene(matches, views, run.settings.matching).error(tried)
    return replace(outcome, models=tuple(models))


def mapping_figures(outcome: Outcome) -> dict[str, Json]:
    """Return the manifest's figures about relative poses and mapping."""
    poses, main = outcome.graph.poses.values(), outcome.models[0]
    dropped = list(outcome.graph.dropped.values())
    kinds = [pose.kind for pose in poses]
    return {
        "mapper": main.mapper,
        "mapper_reason": outcome.reason,
        "hypotheses": [trial.to_dict() for trial in outcome.trials],
        "explained_matches": sum(pair.matches for pair in main.explained.values()),
        "contradicted_matches": sum(pair.contradicted for pair in main.explained.values()),
        "cut_apart": list(outcome.cuts),
        "pairs": {kind: kinds.count(kind) for kind in sorted(set(kinds))}
        | {"found with the help of others": sum(pose.guided for pose in poses)},
        "pairs_dropped": {reason: dropped.count(reason) for reason in sorted(set(dropped))},
    }


def _adjustment_problems(adjusted: Sequence[Adjustment], names: Mapping[str, str]) -> dict[str, Json]:
    """Return the manifest's entries about problems of the last adjustment; empty without any."""
    main, others = adjusted[0], adjusted[1:]
    cameras = {image.camera_id: names[image.name] for image in posed_images(main.model)}
    problems: dict[str, Json] = {
        "failed": main.failure,
        "failed_in_other_models": {str(number): one.failure for number, one in enumerate(others, 1) if one.failure},
        "cameras_held": [cameras[camera_id] for camera_id in main.held],
        "points_left_open": main.open_points,
    }
    return {key: value for key, value in problems.items() if value}
