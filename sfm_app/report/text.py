"""Results in sentences."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

from sfm_app.camera.bearings import field_of_view_deg
from sfm_app.camera.models import calibration_from_model
from sfm_app.frame.sighted_points import Distance
from sfm_app.types import Calibration, CameraModel, Intrinsics, Scene
from sfm_app.types.camera import EQUIRECTANGULAR, FISHEYE, GIVEN, KEPT, PERSPECTIVE
from sfm_app.wording import format_length, list_names

# A calibration in words that need no knowledge of cameras.

SOURCES = {"exif": "what the camera wrote into the files", "guess": "the usual guess", "estimate": "an estimate"}
HELD = {
    "center": "optical center near the middle of the photo",
    "aspect": "square pixels",
    "k1": "a lens that bends no lines",
}
"""The usual value, by the parameter that the photos do not determine."""
WIDE_DEG = 90.0
"""Field of view from which people call a lens a fisheye. Chosen by hand."""
SURE = 2.0
"""Distortion in deviations from which on its direction is said: 19 in 20. By convention."""


WARNING = "beware: "
"""How the texts of a run begin what one should look at."""


def field_text(camera: Calibration) -> str:
    """Return what the camera sees, through its lens."""
    if camera.projection == EQUIRECTANGULAR:
        return "panoramas of a whole turn"
    across, down = field_of_view_deg(camera)
    seen = f"sees {across:.0f} degrees from left to right, {down:.0f} from top to bottom"
    # through a narrow field both families are the same lens, in other numbers
    return f"a fisheye that {seen}" if camera.projection == FISHEYE and max(across, down) >= WIDE_DEG else seen


def verdict(camera: Calibration) -> str:
    """Return whether K is known; if not, why, and where the given values come from."""
    if camera.is_given:
        return "Given: this is what the user knows about the camera."
    if camera.identifiable:
        return "Known: the photos agree on this camera."
    source = SOURCES.get(camera.method, camera.method)
    return f"Not known: what follows is {source}, since these photos do not determine the camera: {camera.reason}."


def focal_text(camera: Calibration) -> str:
    """Return focal length and field of view."""
    if camera.projection == EQUIRECTANGULAR:
        return f"Panoramas of a whole turn, {camera.width} x {camera.height} px."
    seen = field_text(camera)
    focal = f"Focal length {camera.focal_px:.0f} px{_deviation(camera, 'fx')}"
    tall = camera.K[0, 0] / camera.K[1, 1]
    shape = (
        "" if "aspect" in camera.held or abs(tall - 1) < 5e-4 else f"; its pixels are {tall:.3f} times as high as wide"
    )
    return f"{focal}: {'the camera ' if camera.projection == PERSPECTIVE else ''}{seen}{shape}."


def center_text(camera: Calibration) -> str:
    """Return the position of the optical center relative to the middle of the photo; empty for panoramas."""
    if camera.projection == EQUIRECTANGULAR:
        return ""
    right, below = camera.K[0, 2] - camera.width / 2, camera.K[1, 2] - camera.height / 2
    if max(abs(right), abs(below)) < 0.5:
        return "Optical center in the middle of the photo."
    across = f"{abs(right):.0f} px{_deviation(camera, 'cx')} {'right' if right > 0 else 'left'} of"
    down = f"{abs(below):.0f} px{_deviation(camera, 'cy')} {'below' if below > 0 else 'above'}"
    return f"Optical center {across} and {down} the middle of the photo."


def lens_text(camera: Calibration) -> str:
    """Return the radial distortion; empty where there is none or the photos do not determine it."""
    if camera.radial == 0.0 or "k1" in camera.held:
        return ""
    if abs(camera.radial) < SURE * camera.spread.get("k1", 0.0):
        return f"The lens hardly bends lines, k1 {camera.radial:.3f} +- {camera.spread['k1']:.3f}."
    shape = "outwards (barrel)" if camera.radial < 0 else "inwards (pincushion)"
    deviation = f" +- {camera.spread['k1']:.3f}" if "k1" in camera.spread else ""
    return f"The lens bends lines {shape}, k1 {camera.radial:.3f}{deviation}."


def held_text(camera: Calibration) -> str:
    """Return which parameters are assumed to have their usual values; empty for none."""
    if not camera.held or not camera.identifiable:
        return ""
    return "Assumed, since the photos do not determine it: " + ", ".join(HELD.get(n, n) for n in camera.held) + "."


def _deviation(camera: Calibration, name: str) -> str:
    value = camera.spread.get(name, 0.0)
    return f" +- {value:.0f}" if value >= 1.5 else f" +- {value:.1f}" if value > 0 else ""


def duration_text(seconds: float) -> str:
    """Return seconds in words."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


# Summaries of a run's cameras: lines of text, and plain values for --json.

BEST_PAIRS = 3
PHOTOS_SHOWN = 4
"""Most key pairs and photos that the text names; --json has all."""

GUESS_SOURCES = {"exif": "EXIF's claim", "guess": "a guess", "estimate": "an estimate"}
"""Where the values of an undetermined camera come from, by its method."""
GIVEN_TEXTS = {GIVEN: "as given, to be refined", KEPT: "as given, and kept"}
"""What becomes of a camera that the user gave, by its method."""


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
        lines.append(f"camera      {f'{name}: ' if many else ''}{_camera_text(camera)}")
        mine = [photo for photo, of in intrinsics.camera_of.items() if of == name]
        if many and mine:
            lines.append(f"            took {list_names(mine, PHOTOS_SHOWN)}")
        if not camera.identifiable:
            source = GUESS_SOURCES.get(camera.method, camera.method)
            lines.append(f"            these photos do not determine it ({camera.reason}): {source}")
        if camera.method in GIVEN_TEXTS:
            lines.append(f"            {GIVEN_TEXTS[camera.method]}")
        if camera.projection != EQUIRECTANGULAR:
            lines.append(f"            {field_text(camera)}")
        lines += [f"            {text}" for text in (lens_text(camera), held_text(camera)) if text]
        if camera.key_pairs:
            named = [[intrinsics.photos.get(key, str(key)) for key in pair] for pair in camera.key_pairs[:BEST_PAIRS]]
            best = ", ".join(f"{first} + {second}" for first, second in named)
            lines.append(f"            best pairs of photos to start from: {best}")
    return lines


def _camera_text(camera: Calibration) -> str:
    """Return K with its deviations; of panoramas, which have no K, what they are."""
    if camera.projection == EQUIRECTANGULAR:
        return f"{field_text(camera)}, {camera.width} x {camera.height} px"
    return k_text(camera.K, camera.spread)


def refined_text(camera: CameraModel) -> str:
    """Return K of a camera after bundle adjustment with its deviations, and what a wide lens sees."""
    known = calibration_from_model(camera.model, camera.params, (camera.width, camera.height))
    if known.projection == EQUIRECTANGULAR:
        return _camera_text(known)
    seen = f"; {field_text(known)}" if known.projection == FISHEYE else ""
    return f"{k_text(camera.K, camera.deviations)}{seen}"


def contradiction_lines(counts: Mapping[str, Any]) -> list[str]:
    """Return remarks about given cameras, and warnings about these and focals of EXIF that the photos contradict.

    Args:
        counts: figures of a stage in the manifest.
    """
    given, claims = counts.get("given_cameras", {}), counts.get("exif_focals", {})
    many = len(claims) > 1
    said = [f"{f'{name}: ' if many else ''}{one['text']}" for name, one in claims.items() if "text" in one]
    return [*counts.get("given_camera_notes", ()), *said] + [
        f"beware: the photos contradict the given camera {name}: {one['text']}"
        for name, camera in given.items()
        for one in camera["contradicted"]
    ]


def k_text(K: Any, spread: Mapping[str, float] = MappingProxyType({})) -> str:
    """Return focals and center in pixels, with standard deviations where they are known.

    Args:
        K: (3, 3) in pixels.
        spread: standard deviations in pixels, by "fx", "fy", "cx", "cy"; any may be missing.
    """
    values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    parts = (
        f"{name} {value:.1f}" + (f" +- {spread[name]:.1f}" if name in spread else "") for name, value in values.items()
    )
    return "  ".join(parts) + " px"


# The real size of a scene, in sentences.

SHOWN = 3
"""Most pieces of evidence that are named."""


def scale_lines(counts: Mapping[str, Any]) -> Iterator[str]:
    """Yield the size of the scene as lines of text.

    Args:
        counts: figures of the stage `scale` in the manifest.
    """
    if counts["unit"] == "meter":
        names = counts["source"].split(", ")
        yield f"size        in meters, +- {counts['deviation_percent']:.2g} %, by {list_names(names, SHOWN)}"
    else:
        yield 'size        not known: "measure" in the report, --markers or --gcp give it'
    for text in (*counts["contradictions"], *counts["problems"]):
        yield f"            beware: {text}"


def distance_text(found: Distance) -> str:
    """Return a distance for people.

    Args:
        found: the distance.
    """
    if not found.metric:
        return (
            f"{found.value:.6g} +- {found.deviation:.2g} in the model's own unit; --scale, --markers or --gcp of "
            "`sfm-app run` turn it into meters"
        )
    return f"{format_length(found.value)} +- {format_length(found.deviation)}"


# Summaries of a run's scene: lines of text, and plain values for --json.

NAMES_SHOWN = 4
"""Most photos of a group that are named."""
MAPPERS = {
    "incremental": "photo after photo",
    "global": "all at once",
    "colmap": "as COLMAP does by itself",
    "parts": "in parts that were joined",
    "grown": "by placing new photos in the model that was there",
}
CONTRADICTED_WARNING_SHARE = 0.1
"""Share of contradicted matches above which the text warns."""
CAMERA_PER_PHOTO_TEXTS = {
    "taken": "one camera for all photos of a size does not explain them: each has its own (a zoom, or several devices)",
    "two": "one camera for all photos of a size does not explain them, two do",
    "left": "a camera for each photo was tried, too, and explains no more",
}
DOUBTS = ("look_alikes", "perhaps_look_alikes", "jumps", "weakly_joined")
UNSURE_ODDS = 10.0
"""Odds (to one) that the model is upright, below which the text warns."""


def scene_summary(scene: Scene, counts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scene as plain values for --json.

    Args:
        scene: product of the stage.
        counts: figures of the stage in the manifest.
    """
    kept = (
        "mapper", "mapper_reason", "pairs", "pairs_dropped", "cut_apart", "other_models", "adjustment", "orientation",
        "second_look", "shutter",
    )  # fmt: skip
    cameras = {name: {**camera.to_dict(), "K": camera.K.round(3).tolist()} for name, camera in scene.cameras.items()}
    return {
        "registered": len(scene.registered),
        "of": len(scene.registered) + len(scene.unregistered),
        "unregistered": dict(scene.unregistered),
        "points": scene.points,
        "mean_reprojection_px": round(scene.mean_reprojection_px, 3),
        "cameras": cameras,
    } | {key: counts[key] for key in (*kept, *DOUBTS) if key in counts}


def scene_lines(scene: Scene, counts: Mapping[str, Any]) -> Iterator[str]:
    """Yield the scene as lines of text.

    Args:
        scene: product of the stage.
        counts: figures of the stage in the manifest.
    """
    summary = scene_summary(scene, counts)
    yield (
        f"scene       {summary['registered']} of {summary['of']} photos placed, {scene.points} points, "
        f"mean reprojection error {summary['mean_reprojection_px']} px"
    )
    yield from (f"            {text}" for text in _remark_lines(summary, counts))
    named = {name for names in summary.get("other_models", ()) for name in names}
    for name, reason in scene.unregistered.items():
        if name not in named:
            yield f"            not placed: {name}: {reason}"
    many = len(scene.cameras) > 1
    for name, camera in scene.cameras.items():
        kept = counts.get("given_cameras", {}).get(name, {}).get("kept", False)
        how = "as given" if kept else "refined"
        yield f"            camera {f'{name} ' if many else ''}{how}: {refined_text(camera)}"
    yield from (f"            {text}" for text in contradiction_lines(counts))


def _remark_lines(summary: Mapping[str, Any], counts: Mapping[str, Any]) -> Iterator[str]:
    if summary.get("mapper") in MAPPERS:
        dropped = sum(summary.get("pairs_dropped", {}).values())
        because = f": {counts['mapper_reason']}" if counts.get("mapper_reason") else ""
        yield f"mapped {MAPPERS[summary['mapper']]}{because}"
        for left in (one["dropped_joins"] for one in counts.get("parts", ()) if one["dropped_joins"]):
            yield f"joins between parts left out because other joins or matches contradict them: {len(left)}"
        if counts.get("rival_tried_because"):
            yield f"COLMAP's own mapper was tried, too: {counts['rival_tried_because']}"
        if counts.get("one_camera_each") in CAMERA_PER_PHOTO_TEXTS:
            yield CAMERA_PER_PHOTO_TEXTS[counts["one_camera_each"]]
        yield from _second_look_lines(counts.get("second_look", {}))
        if dropped:
            yield f"pairs of photos left out because they do not fit the others: {dropped}"
    for photos in summary.get("cut_apart", ()):
        yield f"split, because more matches contradict the connection than support it: {photos}"
    yield from _doubt_lines(summary)
    for number, names in enumerate(summary.get("other_models", ()), start=1):
        yield f"another model of {len(names)} photos in other_models/{number}: {list_names(names, NAMES_SHOWN)}"
    explained, against = counts.get("explained_matches", 0), counts.get("contradicted_matches", 0)
    if against > CONTRADICTED_WARNING_SHARE * (explained + against):
        yield (
            f"beware: {100 * against / (explained + against):.0f} % of the matches between these photos contradict it; "
            "look for places that look alike"
        )
    yield from _shutter_lines(summary.get("shutter", {}))
    yield from _adjustment_warnings(summary.get("adjustment", {}))
    orientation = summary.get("orientation", {})
    if orientation.get("failed"):
        yield f"frame as left by mapping, neither upright nor in meters: {orientation['failed']}"
    elif orientation:
        deviation = orientation["up_deviation_deg"]
        sure = f"to about {max(deviation, 0.1):.1f} degrees" if deviation is not None else "with unknown accuracy"
        meters = "; in meters by GPS" if orientation["unit"] == "meter" else ""  # the stage `scale` may know others
        yield f"upright by {orientation['up']}, {sure}{meters}"
        yield from _orientation_warnings(orientation)


def _second_look_lines(found: Mapping[str, Any]) -> Iterator[str]:
    """Yield the result of mapping again with finer features."""
    if found:
        before, after = found["placed"][0], found["placed"][-1]
        brought = f"{after} photos placed instead of {before}" if found["taken"] else "no more photos placed"
        failed = f" (it failed: {found['failed']})" if found.get("failed") else ""
        yield f"finer features were sought in {len(found['photos'])} unplaced photos: {brought}{failed}"


def _shutter_lines(found: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is known of the shutter of a video."""
    if not found:
        return
    time = f"{found['readout_ms']:.1f} +- {found['deviation_ms']:.1f} ms" if "readout_ms" in found else ""
    if found["compensated"]:
        interval = f"at {found['interval_ms']:.0f} ms per frame"
        yield f"rolling shutter: rows are read within {time}, {interval}; poses are those of the middle rows"
    else:
        yield f"rolling shutter: {found['because']}{f' ({time})' if time else ''}, so nothing is compensated"


def _adjustment_warnings(adjustment: Mapping[str, Any]) -> Iterator[str]:
    """Yield warnings about the last bundle adjustment."""
    if adjustment.get("failed"):
        yield (
            f"beware: the last adjustment failed ({adjustment['failed']}); cameras and poses are as mapping left them, "
            "and their errors are unknown"
        )
    for number, reason in adjustment.get("failed_in_other_models", {}).items():
        yield f"beware: the last adjustment of other_models/{number} failed ({reason})"
    for name in adjustment.get("cameras_held", ()):
        yield f"beware: these photos do not determine camera {name}; it stayed as mapping left it"


def _doubt_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield warnings about look-alikes, possible folds, and parts whose scale is weakly determined."""
    for join in summary.get("look_alikes", ()):
        here, there = (list_names(names, NAMES_SHOWN) for names in join["between"])
        yield (
            f"look-alikes separated, {join['pairs']} pairs of photos: {here} | {there} "
            f"({100 * join['missing']:.0f} % of what they would share in one place is missing)"
        )
    for join in summary.get("perhaps_look_alikes", ()):
        here, there = (list_names(names, NAMES_SHOWN) for names in join["between"])
        yield (
            f"beware: a loop, or look-alikes: {join['pairs']} pairs take {here} and {there} for one place, "
            "but the photos between them do not confirm it"
        )
    for names in summary.get("weakly_joined", ()):
        yield (
            f"beware: hardly any point determines how far {list_names(names, NAMES_SHOWN)} "
            f"{'are' if len(names) > 1 else 'is'} from the rest; photos between them help"
        )
    for before, after in summary.get("jumps", ()):
        yield f"beware: a jump from {before} to {after}, which are consecutive: in a video, a sign of look-alikes"


def _orientation_warnings(orientation: Mapping[str, Any]) -> Iterator[str]:
    """Yield a warning where the model may not be upright, with the setting that corrects it."""
    mistakes = {"up_sign_odds": ("stand upside down", (180,)), "up_axis_odds": ("lie on its side", (90, 270))}
    for key, (what, turns) in mistakes.items():
        odds = orientation.get(key, UNSURE_ODDS)
        if odds < UNSURE_ODDS:
            others = " or ".join(str((orientation["photos_turned_deg"] + turn) % 360) for turn in turns)
            yield (
                f"beware: it may {what} (odds {odds:.1f} to 1 against): look at it; if so, "
                f"run it again with --set scene.photo_rotation_deg={others}"
            )
