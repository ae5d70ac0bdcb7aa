"""Results in sentences and, for --json, as plain values."""

from collections.abc import Iterator, Mapping
from statistics import median
from types import MappingProxyType
from typing import Any

from sfm_app.camera.bearings import field_of_view_deg
from sfm_app.camera.models import calibration_from_model
from sfm_app.frame.sighted_points import Distance
from sfm_app.frame.volumes import Volume
from sfm_app.settings import FIRST_TRIAL, HYPOTHESES
from sfm_app.types import Calibration, CameraModel, Intrinsics, Scene
from sfm_app.types.camera import CLAIM, EQUIRECTANGULAR, FISHEYE, GIVEN, KEPT
from sfm_app.wording import format_length, list_names

# A calibration in everyday words.

SOURCES = {CLAIM: "a claim", "guess": "a guess", "estimate": "an estimate"}
"""Source of the values of an undetermined camera, by its method."""
HELD = {
    "center": "optical center near the middle of the photo",
    "aspect": "square pixels",
    "k1": "a lens that bends no lines",
}
"""Assumed value, by parameter."""
REMEDY = "add photos from nearer, farther and higher, some turned on their side, or use --calibration FILE"
"""For a camera that photos do not determine; short, since the terminal cuts warnings."""
UNSURE_FOCAL = 1.0 / 30.0
"""Relative deviation of a focal above which photos do not determine it: three deviations change depths by a tenth."""
WARNING = "beware: "
"""Prefix of warnings."""


def field_text(camera: Calibration) -> str:
    """Return the field of view in words."""
    if camera.projection == EQUIRECTANGULAR:
        return "360-degree panoramas"
    across, down = field_of_view_deg(camera)
    field = f"sees {across:.0f} degrees from left to right, {down:.0f} from top to bottom"
    # with a narrow field, fisheye and perspective models describe the same lens. 90 degrees by hand
    return f"a fisheye that {field}" if camera.projection == FISHEYE and max(across, down) >= 90.0 else field


def lens_text(camera: Calibration) -> str:
    """Return the radial distortion; empty if there is none or the photos do not determine it."""
    if camera.radial == 0.0 or "k1" in camera.held:
        return ""
    if abs(camera.radial) < 2.0 * camera.spread.get("k1", 0.0):
        return f"The lens hardly bends lines, k1 {camera.radial:.3f} +- {camera.spread['k1']:.3f}."
    shape = "outwards (barrel)" if camera.radial < 0 else "inwards (pincushion)"
    deviation = f" +- {camera.spread['k1']:.3f}" if "k1" in camera.spread else ""
    return f"The lens bends lines {shape}, k1 {camera.radial:.3f}{deviation}."


def held_text(camera: Calibration) -> str:
    """Return the parameters with assumed values; empty for none."""
    if not camera.held or not camera.identifiable:
        return ""
    return "Assumed, since the photos do not determine it: " + ", ".join(HELD.get(n, n) for n in camera.held) + "."


def duration_text(seconds: float) -> str:
    """Return seconds in words."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


# Summaries of a run's cameras: lines of text, and plain values for --json.

NAMES_SHOWN = 4
"""Most photos of a group that the text names; --json has all. By hand."""
GIVEN_TEXTS = {GIVEN: "as given, to be refined", KEPT: "as given, and kept"}
"""Use of a given camera, by its method."""


def intrinsics_summary(intrinsics: Intrinsics) -> dict[str, Any]:
    """Return the calibrations as plain values for --json."""
    names = intrinsics.photos
    cameras = {
        name: {"field_of_view_deg": [round(angle, 2) for angle in field_of_view_deg(camera)], **camera.to_dict()}
        for name, camera in intrinsics.cameras.items()
    }
    for camera in cameras.values():
        camera["key_pairs"] = [[names.get(key, str(key)) for key in pair] for pair in camera["key_pairs"]]
    return cameras


def intrinsics_lines(intrinsics: Intrinsics) -> list[str]:
    """Return the calibrations as lines of text."""
    many = len(intrinsics.cameras) > 1
    lines = []
    for name, camera in intrinsics.cameras.items():
        first, *others = camera_texts(camera)
        lines.append(f"camera      {f'{name}: ' if many else ''}{first}")
        photos = [photo for photo, of in intrinsics.camera_of.items() if of == name]
        if many and photos:
            lines.append(f"            took {list_names(photos, NAMES_SHOWN)}")
        if camera.key_pairs:
            named = [[intrinsics.photos.get(key, str(key)) for key in pair] for pair in camera.key_pairs[:3]]
            others.append(f"best initial pairs of photos: {', '.join(' + '.join(pair) for pair in named)}")
        lines += [f"            {text}" for text in others]
    return lines


def camera_texts(camera: Calibration) -> Iterator[str]:
    """Yield a calibration, one text per property: K first, then its source, field of view, lens and assumptions."""
    yield _camera_text(camera)
    if not camera.identifiable:
        source = SOURCES.get(camera.method, camera.method)
        yield f"these photos do not determine it ({camera.reason}): {source}"
    if camera.method in GIVEN_TEXTS:
        yield GIVEN_TEXTS[camera.method]
    if camera.projection != EQUIRECTANGULAR:
        yield field_text(camera)
    yield from filter(None, (lens_text(camera), held_text(camera)))


def _camera_text(camera: Calibration) -> str:
    if camera.projection == EQUIRECTANGULAR:
        return f"{field_text(camera)}, {camera.width} x {camera.height} px"
    return k_text(camera.K, camera.spread)


def refined_text(camera: CameraModel) -> str:
    """Return K of a camera after bundle adjustment with its deviations, and the field of a wide lens."""
    known = calibration_from_model(camera.model, camera.params, (camera.width, camera.height))
    if known.projection == EQUIRECTANGULAR:
        return _camera_text(known)
    field = f"; {field_text(known)}" if known.projection == FISHEYE else ""
    return f"{k_text(camera.K, camera.deviations)}{field}"


def contradiction_lines(counts: Mapping[str, Any]) -> list[str]:
    """Return remarks and warnings about given and claimed cameras that the photos contradict."""
    given, claims = counts.get("given_cameras", {}), counts.get("camera_claims", {})
    many = len(claims) > 1
    remarks = [f"{f'{name}: ' if many else ''}{one['text']}" for name, one in claims.items() if "text" in one]
    return [*counts.get("given_camera_notes", ()), *remarks] + [
        f"beware: the photos contradict the given camera {name}: {one['text']}"
        for name, camera in given.items()
        for one in camera["contradicted"]
    ]


def k_text(K: Any, spread: Mapping[str, float] = MappingProxyType({})) -> str:
    """Return focals and center of K (3, 3) in pixels, with those standard deviations that are known."""
    values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    parts = (f"{k} {v:.1f}" + (f" +- {spread[k]:.1f}" if k in spread else "") for k, v in values.items())
    return "  ".join(parts) + " px"


# The real size of a scene.


def scale_lines(counts: Mapping[str, Any]) -> Iterator[str]:
    """Yield the size of the scene, from the figures of the stage `scale`."""
    if counts["unit"] == "meter":
        names = counts["source"].split(", ")
        yield f"size        in meters, +- {counts['deviation_percent']:.2g} %, by {list_names(names, 3)}"
    else:
        yield "size        unknown: measure it in the report, or use --markers or --gcp"
    if counts.get("level"):
        yield "            upright by the level surfaces that you have given"
    checks = counts.get("check_points")
    if checks:
        inside, outside = checks["inside"], checks["outside"]
        plan, height = (format_length(checks[key]) for key in ("plan_rms_m", "height_rms_m"))
        yield (
            f"            {len(inside)} of {len(inside) + len(outside)} check points lie inside three of their "
            f"deviations: off by {plan} in plan and {height} in height"
        )
        if outside:
            yield (
                f"            beware: off by more than their deviations explain: {list_names(outside, NAMES_SHOWN)}. "
                "Compare their marks and the survey"
            )
    for text in (*counts["contradictions"], *counts["problems"]):
        yield f"            beware: {text}"


def distance_text(distance: Distance) -> str:
    """Return a distance with its deviation."""
    if not distance.metric:
        return (
            f"{distance.value:.6g} +- {distance.deviation:.2g} in the model's own unit; `sfm-app run` with --scale, "
            "--markers or --gcp gives meters"
        )
    return f"{format_length(distance.value)} +- {format_length(distance.deviation)}"


def volume_lines(volume: Volume) -> Iterator[str]:
    """Yield volumes with their deviations, and what they stand on."""
    cube, square = ("m3", "m2") if volume.metric else ("", "")
    for name, value, deviation in (
        ("above the plane (cut)", volume.cut, volume.cut_deviation),
        ("below the plane (fill)", volume.fill, volume.fill_deviation),
        ("above less below (net)", volume.net, volume.net_deviation),
    ):
        yield f"{name:<24}{value:.4g} +- {deviation:.2g} {cube}".rstrip()
    yield f"{'area':<24}{volume.area:.4g} {square}".rstrip()
    if volume.missing > 0:
        yield f"beware: {100 * volume.missing:.2g} % of the area has no surface: the heights beside it count there"
    if not volume.metric:
        yield "in the model's own unit; `sfm-app run` with --scale, --markers or --gcp gives meters"


# A whole run.


def result_lines(intrinsics: Intrinsics | None, scene: Scene | None, stages: Mapping[str, Any]) -> list[str]:
    """Return cameras, scene and size as lines of text; `stages` are the records of the manifest."""
    counts = {name: stage["counts"] for name, stage in stages.items()}
    lines = [f"            {WARNING}{text}" for text in input_warnings(counts.get("photos", {}))]
    lines += intrinsics_lines(intrinsics) if intrinsics is not None else []
    for stage in ("view_graph", "intrinsics"):
        lines += [f"            {text}" for text in contradiction_lines(counts.get(stage, {}))]
    if scene is not None:
        is_leveled = counts.get("scale", {}).get("level", 0)  # the user knows what is up
        lines += scene_lines(scene, counts.get("scene", {}) | ({"orientation": {}} if is_leveled else {}))
    return [*lines, *scale_lines(counts["scale"])] if "scale" in counts else lines


def input_warnings(counts: Mapping[str, Any]) -> Iterator[str]:
    """Yield what masks and positions are of no use, from the figures of the stage `photos`."""
    masks = counts.get("masks", {})
    useless = {"masks hide nothing": masks.get("white"), "masks belong to no photo": masks.get("unused")}
    useless |= {f"{file} names photos that are not there": names for file, names in counts.get("missing", {}).items()}
    yield from (f"{what}: {list_names(names, NAMES_SHOWN)}" for what, names in useless.items() if names)


# Summaries of a run's scene: lines of text, and plain values for --json.

MAPPERS = {
    "incremental": "incrementally",
    "global": "globally",
    "colmap": "by COLMAP's default pipeline",
    "parts": "in parts, then joined",
    "grown": "by adding the new photos to the earlier model",
}
DOUBTS = ("look_alikes", "perhaps_look_alikes", "jumps", "weakly_joined")
UNSURE_ODDS = 10.0
"""Odds (to one) that the model is upright, below which the text warns. By hand."""


def scene_summary(scene: Scene, counts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scene as plain values for --json; `counts` are figures of the stage."""
    keys = (
        "mapper", "mapper_reason", "pairs", "pairs_dropped", "cut_apart", "other_models", "adjustment", "orientation",
        "hypotheses", "shutter",
    )  # fmt: skip
    cameras = {name: {**camera.to_dict(), "K": camera.K.round(3).tolist()} for name, camera in scene.cameras.items()}
    return {
        "registered": len(scene.registered),
        "of": len(scene.registered) + len(scene.unregistered),
        "unregistered": dict(scene.unregistered),
        "points": scene.points,
        "mean_reprojection_px": round(scene.mean_reprojection_px, 3),
        "cameras": cameras,
    } | {key: counts[key] for key in (*keys, *DOUBTS) if key in counts}


def scene_lines(scene: Scene, counts: Mapping[str, Any]) -> Iterator[str]:
    """Yield the scene as lines of text; `counts` are figures of the stage."""
    placed = len(scene.registered)
    yield (
        f"scene       {placed} of {placed + len(scene.unregistered)} photos placed, {scene.points} points, "
        f"mean reprojection error {round(scene.mean_reprojection_px, 3)} px"
    )
    yield from (f"            {text}" for text in _remark_lines(scene, counts))
    named = {name for names in counts.get("other_models", ()) for name in names}
    for name, reason in scene.unregistered.items():
        if name not in named:
            yield f"            not placed: {name}: {reason}"
    many = len(scene.cameras) > 1
    for name, camera in scene.cameras.items():
        is_fixed = counts.get("given_cameras", {}).get(name, {}).get("kept", False)
        state = "as given" if is_fixed else "refined"
        yield f"            camera {f'{name} ' if many else ''}{state}: {refined_text(camera)}"
    yield from (f"            {text}" for text in contradiction_lines(counts))


def _remark_lines(scene: Scene, counts: Mapping[str, Any]) -> Iterator[str]:
    if counts.get("mapper") in MAPPERS:
        yield from _mapping_lines(counts)
    for photos in counts.get("cut_apart", ()):
        yield f"split, because more matches contradict the connection than support it: {photos}"
    for join in counts.get("look_alikes", ()):
        here, there = (list_names(names, NAMES_SHOWN) for names in join["between"])
        yield (
            f"look-alikes separated, {join['pairs']} pairs of photos: {here} | {there} "
            f"({100 * join['missing']:.0f} % of the expected overlap is missing)"
        )
    yield from place_warnings(scene, counts)
    for number, names in enumerate(counts.get("other_models", ()), start=1):
        yield f"another model of {len(names)} photos in other_models/{number}: {list_names(names, NAMES_SHOWN)}"
    yield from _shutter_lines(counts.get("shutter", {}))
    yield from _adjustment_warnings(counts.get("adjustment", {}))
    yield from _orientation_lines(counts.get("orientation", {}))


def _mapping_lines(counts: Mapping[str, Any]) -> Iterator[str]:
    because = f": {counts['mapper_reason']}" if counts.get("mapper_reason") else ""
    yield f"mapped {MAPPERS[counts['mapper']]}{because}"
    for joins in (one["dropped_joins"] for one in counts.get("parts", ()) if one["dropped_joins"]):
        yield f"rejected joins between parts, which other joins or matches contradict: {len(joins)}"
    for trial in counts.get("hypotheses", ()):
        if (name := trial["name"].removeprefix(f"{FIRST_TRIAL}: ")) in HYPOTHESES:
            before, after = trial["photos"]
            gain = f"{after} photos instead of {before}" if after != before else "it is better"
            failed = f"it failed: {trial['failure']}" if trial["failure"] else "it is no better"
            result = gain if trial["accepted"] else failed
            yield f"tried {HYPOTHESES[name]}, because {trial['reason']}: {result}"
    if dropped := sum(counts.get("pairs_dropped", {}).values()):
        yield f"rejected pairs of photos that contradict the others: {dropped}"


def _shutter_lines(shutter: Mapping[str, Any]) -> Iterator[str]:
    if not shutter:
        return
    time = f"{shutter['readout_ms']:.1f} +- {shutter['deviation_ms']:.1f} ms" if "readout_ms" in shutter else ""
    if shutter["compensated"]:
        yield f"rolling shutter: readout {time} of {shutter['interval_ms']:.0f} ms per frame; poses are of middle rows"
    else:
        yield f"rolling shutter, not compensated: {shutter['because']}{f' ({time})' if time else ''}"


def _adjustment_warnings(adjustment: Mapping[str, Any]) -> Iterator[str]:
    for number, reason in adjustment.get("failed_in_other_models", {}).items():
        yield f"beware: the last adjustment of other_models/{number} failed ({reason})"
    for name in adjustment.get("cameras_held", ()):
        yield f"beware: these photos do not determine camera {name}; it keeps its values from mapping"


def place_warnings(scene: Scene, counts: Mapping[str, Any]) -> Iterator[str]:
    """Yield the warnings that photos may be in wrong places; `counts` are figures of the stage `scene`."""
    doubts = {photo: scene.cameras[name].focal_doubt for photo, name in scene.camera_of.items()}
    unsure = [photo for photo, doubt in doubts.items() if doubt > UNSURE_FOCAL]
    if unsure:
        percent = 100 * median(doubts[photo] for photo in unsure)
        of = f" of {list_names(unsure, NAMES_SHOWN)}" if 2 * len(unsure) <= len(doubts) else ""
        yield f"beware: the focal length{of} is uncertain by {percent:.0f} %, and depths with it: {REMEDY}"
    if failure := counts.get("adjustment", {}).get("failed"):
        yield f"beware: the last adjustment failed ({failure}), so places and depths are those of mapping: {REMEDY}"
    for join in counts.get("perhaps_look_alikes", ()):
        here, there = (list_names(names, NAMES_SHOWN) for names in join["between"])
        yield f"beware: a loop, or look-alikes: {join['pairs']} pairs match {here} with {there}, without photos between"
    for names in counts.get("weakly_joined", ()):
        text = list_names(names, NAMES_SHOWN)
        yield f"beware: few points determine the distance of {text} from the rest; take more photos between them"
    for before, after in counts.get("jumps", ()):
        yield f"beware: a jump between the consecutive photos {before} and {after}; in a video, a sign of look-alikes"
    if any(trial["name"] == "false-joins" and trial["accepted"] for trial in counts.get("hypotheses", ())):
        yield "beware: some sides of this place look alike; photos may be on a wrong one: take more around its corners"
    explained, against = counts.get("explained_matches", 0), counts.get("contradicted_matches", 0)
    if against > 0.1 * (explained + against):
        yield (
            f"beware: {100 * against / (explained + against):.0f} % of the matches between these photos contradict "
            "the model; look for places that look alike"
        )


def _orientation_lines(orientation: Mapping[str, Any]) -> Iterator[str]:
    """Yield the up direction; a warning if the model may not be upright comes with the setting that corrects it."""
    if orientation.get("failed"):
        yield f"the frame is that of mapping, neither upright nor in meters: {orientation['failed']}"
    if not orientation or orientation.get("failed"):
        return
    deviation = orientation["up_deviation_deg"]
    accuracy = f"to about {max(deviation, 0.1):.1f} degrees" if deviation is not None else "with unknown accuracy"
    meters = "; in meters by GPS" if orientation["unit"] == "meter" else ""  # the stage `scale` may know others
    yield f"upright by {orientation['up']}, {accuracy}{meters}"
    if "swapped" in orientation.get("gps", ""):
        yield f"beware: GPS is {orientation['gps']}"
    for key, what in {"up_sign_odds": "stand upside down", "up_axis_odds": "lie on its side"}.items():
        odds = orientation.get(key, UNSURE_ODDS)
        if odds < UNSURE_ODDS:
            yield f"beware: the model may {what} (odds {odds:.1f} to 1 against); if so, press upright in the 3D view"
