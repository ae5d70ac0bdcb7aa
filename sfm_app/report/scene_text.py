"""Summaries of a run's scene: lines of text, and plain values for --json."""

from collections.abc import Iterator, Mapping
from typing import Any

from sfm_app.name_lists import list_names
from sfm_app.report.camera_text import contradiction_lines, refined_text
from sfm_app.types import Scene

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
