"""scale: PhotoSet and Scene -> MetricFrame, the frame of everything that is exported."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sfm_app.colmap.model import sparse_model
from sfm_app.frame import known_lengths
from sfm_app.frame.control_points import ControlFit, find_mistake, fit_control_points
from sfm_app.frame.scale import CHECK, GPS, MetricFrame, ScaleEvidence, SurveyedPoint, agree, move_model, stand_upright
from sfm_app.frame.sighted_points import PosedPhotos
from sfm_app.numerical import Json
from sfm_app.products import write_frame
from sfm_app.runtime.context import RunContext
from sfm_app.types import PhotoSet, Scene
from sfm_app.wording import format_length

POINTS = "points"
"""Name of the files with the points and cameras."""


def make(photos: PhotoSet, scene: Scene, run: RunContext) -> MetricFrame:
    """Find size and place of the scene from all evidence, and write its points and cameras in that frame.

    Missing or contradictory evidence is recorded and never ends the run; without any, the unit stays arbitrary.
    """
    options, evidence, problems = run.settings.scale, list[ScaleEvidence](), list[str]()
    if scene.gps_deviation is not None:
        evidence.append(ScaleEvidence(GPS, 1.0, max(scene.gps_deviation, 1e-4), len(scene.registered)))
    # the proportions are as exact as the least exact focal length
    shares = (one.deviations.get("fx", 0.0) / one.K[0, 0] for one in scene.cameras.values())
    shape = float(max((share for share in shares if np.isfinite(share)), default=0.0))
    control: ControlFit | None = None
    if options.distances or options.markers or run.control_points:
        posed = PosedPhotos(scene.model_dir)
        if options.distances:
            evidence += known_lengths.distance_evidence(options.distances, posed.sightlines())
        if options.markers:
            evidence += known_lengths.marker_evidence(posed, run, problems)
        if run.control_points:
            control = _control_evidence(photos, posed, shape, run, evidence, problems)
    frame = _agreed_frame(evidence, control, shape)
    frame = frame if control else replace(frame, place=scene.gps_place)
    if options.level and frame.place is not None:
        problems.append("the level surfaces are not used: the place on the map also gives the up direction")
    elif options.level:
        frame = stand_upright(frame, options.level)
        run.record(level=len(options.level))
    run.record(
        unit="meter" if frame.is_metric else "arbitrary",
        scale=frame.from_model.scale,
        deviation_percent=None if frame.deviation is None else round(100 * frame.deviation, 4),
        source=frame.source,
        evidence=[
            {
                "name": one.name,
                "scale": one.scale,
                "deviation_percent": round(100 * one.deviation, 4),
                "photos": one.photos,
            }
            for one in evidence
        ],
        contradictions=list(frame.contradictions),
        problems=problems,
    )
    write_frame(frame, run.workspace)
    points = sparse_model(run.workspace.sparse)
    run.write_model(move_model(points, frame.from_model) if frame.changes else points, POINTS)
    return frame


def _control_evidence(
    photos: PhotoSet,
    posed: PosedPhotos,
    shape: float,
    run: RunContext,
    evidence: list[ScaleEvidence],
    problems: list[str],
) -> ControlFit | None:
    """Return the fit to ground control points, and add to the evidence and the problems.

    `shape` is the relative deviation of the model's proportions.
    """
    given = run.control_points
    if known_lengths.is_normalized(given):
        given = known_lengths.marks_in_pixels(photos, given)
        fit = fit_control_points(given, known_lengths.control_places(photos, posed, given, []))
        reason = fit if isinstance(fit, str) else f"so read, the points miss by {format_length(fit.rms_m)}"
        problems.append(f"all marks lie between 0 and 1, as shares of width and height ({reason}): write pixels")
        return None
    located = known_lengths.control_places(photos, posed, given, problems)
    fit = fit_control_points(given, located, shape)
    if isinstance(fit, str):
        problems.append(fit)
        return None
    mistake, unusable = find_mistake(given, located, [photo.gps for photo in photos.photos if photo.gps is not None])
    if mistake:
        problems.append(f"{mistake}. They are not used" if unusable else mistake)
    if unusable:
        return None
    for name, miss in fit.outliers.items():
        problems.append(f"ground control point '{name}' contradicts the others: it is {miss:.3g} m off, and left out")
    evidence.append(ScaleEvidence(f"{len(fit.inliers)} ground control points", fit.from_model.scale, fit.deviation))
    used = {"used": list(fit.inliers), "wrong": dict(fit.outliers), "rms_m": fit.rms_m}
    run.record(control_points={"system": fit.place.system, **used}, **_check_figures(fit.surveyed))
    return fit


def _check_figures(surveyed: Sequence[SurveyedPoint]) -> dict[str, Json]:
    """Return the check points that agree, those that do not, and their root mean squares; empty without any."""
    checks = [one for one in surveyed if one.role == CHECK]
    if not checks:
        return {}
    inside, outside = ([one.name for one in checks if one.is_inside is which] for which in (True, False))
    plan, height = np.sqrt(np.mean([[one.plan_m**2, one.height_m**2] for one in checks], axis=0)).tolist()
    return {"check_points": {"inside": inside, "outside": outside, "plan_rms_m": plan, "height_rms_m": height}}


def _agreed_frame(evidence: Sequence[ScaleEvidence], control: ControlFit | None, shape: float) -> MetricFrame:
    """Return the frame by the agreed scale; ground control points also give its place and directions."""
    frame = agree(evidence, shape)
    if control is None:
        return frame
    difference = abs(float(np.log(frame.from_model.scale / control.from_model.scale)))
    return replace(
        frame,
        from_model=control.from_model,
        deviation=max(float(np.hypot(control.deviation, shape)), difference),
        place=control.place,
        surveyed=control.surveyed,
    )
