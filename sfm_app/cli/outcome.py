"""The result of a run on stdout: all figures, the few lines that a user needs, and the next commands."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any

from sfm_app.api import Run
from sfm_app.camera.models import calibration_from_model
from sfm_app.cli.output import WIDTH, file_lines
from sfm_app.report.text import (
    SOURCES,
    UNSURE_FOCAL,
    WARNING,
    duration_text,
    field_text,
    intrinsics_summary,
    result_lines,
    scale_lines,
    scene_summary,
)
from sfm_app.runtime.workspace import model_triangles
from sfm_app.settings import Settings
from sfm_app.types.camera import EQUIRECTANGULAR
from sfm_app.wording import list_names

LABEL_COLUMNS = 12
INDENT = " " * LABEL_COLUMNS
NAMES_SHOWN = 5
"""Most names in one list; the manifest has all."""
LINES_SHOWN = 3
"""Most cameras, warnings, and missing photos; the report has all."""
WARNING_WIDTH = 160
"""Most characters of a warning."""
REUSE_RATIO = 1.2
"""Ratio of the seconds of all stages and of this command above which both are printed: the run reused stages."""


def run_summary(run: Run) -> dict[str, Any]:
    """Return the figures of a run as plain values for --json."""
    stages = _stages(run)
    counts = {name: stage["counts"] for name, stage in stages.items()}
    photos = counts.get("photos", {})
    given_cameras = {name: part["given_cameras"] for name, part in counts.items() if "given_cameras" in part}
    summary: dict[str, Any] = {
        "out": str(run.out),
        "photos": {key: photos.get(key, {}) for key in ("usable", "unusable", "notes")},
        "masks": photos.get("masks"),
        "pairs": {key: counts.get("view_graph", {}).get(key) for key in ("kept", "rejected")},
        "calibration": intrinsics_summary(run.calibration) if run.calibration else None,
        "report": str(run.report_path) if run.report_path else None,
        "seconds": {name: stage["seconds"] for name, stage in stages.items()},
    }
    optional = {"video": photos.get("video"), "missing": photos.get("missing"), "given_cameras": given_cameras}
    summary |= {name: value for name, value in optional.items() if value}
    if run.scene:
        points = [str(path) for path in _model_files(run, "scale")]
        summary["scene"] = {**scene_summary(run.scene, counts.get("scene", {})), "files": points}
    if "scale" in counts:
        summary["scale"] = counts["scale"]
    if run.mesh_path:
        files = [str(path) for path in _model_files(run, "files")]
        texture = {key: counts["files"][key] for key in ("pages_px", "jpeg_quality") if key in counts["files"]}
        summary["mesh"] = {"triangles": model_triangles(stages), **texture, "files": files}
    return summary


def run_lines(run: Run) -> list[str]:
    """Return all figures of a run as lines of text."""
    summary = run_summary(run)
    lines = [*_input_lines(summary), *result_lines(run.calibration, run.scene, _stages(run))]
    if run.scene:
        lines += [f"points      {line}" for line in file_lines(_model_files(run, "scale"))]
    if run.mesh_path:
        lines.append(f"mesh        {summary['mesh']['triangles']} triangles{_texture_text(summary['mesh'])}")
        lines += [f"{INDENT}{line}" for line in file_lines(_model_files(run, "files"))]
    if run.report_path:
        lines.append(f"report      {file_lines([run.report_path])[0]}")
    seconds = summary["seconds"]
    parts = ", ".join(f"{name} {value:.1f}" for name, value in seconds.items())
    return [*lines, f"seconds     {parts}; total {sum(seconds.values()):.1f}"]


def _input_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    if "video" in summary:
        yield from _video_lines(summary["video"])
    yield f"photos      {summary['photos']['usable']} usable"
    yield from (f"{INDENT}{line}" for line in _photo_lines(summary["photos"]))
    yield from _mask_lines(summary)
    if summary["pairs"]["kept"] is not None:
        rejected = ", ".join(f"{count} {reason}" for reason, count in summary["pairs"]["rejected"].items())
        yield f"pairs       {summary['pairs']['kept']} verified" + (f"; rejected: {rejected}" if rejected else "")


def outcome_lines(run: Run, seconds: float) -> list[str]:
    """Return what a user needs of a run up to any stage: result, accuracy, warnings, files."""
    summary = run_summary(run)
    stage_seconds = sum(summary["seconds"].values())
    earlier = f", {duration_text(stage_seconds)} with earlier runs" if stage_seconds > REUSE_RATIO * seconds else ""
    return [
        f"{_headline(run)}.",
        *(_video_lines(summary["video"]) if "video" in summary else ()),
        *_mask_lines(summary),
        *_accuracy_lines(run),
        *_missing_lines(run, summary["photos"]),
        *_warning_lines(run),
        *_file_lines(run),
        f"took        {duration_text(seconds)}{earlier}; -v prints all results",
    ]


def _headline(run: Run) -> str:
    if run.scene is None:
        usable = _counts(run, "photos").get("usable", 0)
        return f"The camera of {usable} photos" if run.calibration else f"{usable} usable photos"
    placed, count = len(run.scene.registered), len(run.scene.registered) + len(run.scene.unregistered)
    photos = f"all {count} photos" if placed == count else f"{placed} of {count} photos"
    if run.mesh_path is None:
        return f"Cameras and points of {photos}"
    triangles = model_triangles(_stages(run))
    return f"A model of {photos}, with {triangles:,} triangles" if triangles else f"A model of {photos}"


def _accuracy_lines(run: Run) -> Iterator[str]:
    if run.scene is not None:
        yield f"accuracy    mean reprojection error {run.scene.mean_reprojection_px:.2g} px"
    yield from _camera_lines(run)
    if counts := _counts(run, "scale"):
        yield next(iter(scale_lines(counts)))


def _camera_lines(run: Run) -> Iterator[str]:
    """Yield focal length and field of view of each camera, after bundle adjustment if there is one."""
    divided = run.scene.camera_of if run.scene is not None else {}
    cameras = run.calibration.divided_as(divided) if run.calibration is not None else {}
    if run.scene is not None and run.scene.cameras:  # without those whose photos are all missing
        cameras = {name: calibration for name, calibration in cameras.items() if name in run.scene.cameras}
    for name, calibration in list(cameras.items())[:LINES_SHOWN]:
        model = run.scene.cameras.get(name) if run.scene is not None else None
        size = calibration.width, calibration.height
        camera = calibration_from_model(model.model, model.params, size) if model else calibration
        deviation = (model.deviations if model else calibration.spread).get("fx")
        focal = f"focal {camera.K[0, 0]:.1f}{f' +- {deviation:.2g}' if deviation else ''} px, "
        label = f"{name}: " if len(cameras) > 1 else ""
        yield f"camera      {label}{'' if camera.projection == EQUIRECTANGULAR else focal}{field_text(camera)}"
        if not calibration.identifiable:
            if model is not None:  # the reason would seem to concern the refined camera
                source = "all photos together do" if model.focal_doubt <= UNSURE_FOCAL else "nor do all photos together"
            else:
                source = f"this is {SOURCES.get(calibration.method, calibration.method)}: {calibration.reason}"
            yield f"{INDENT}pairs of photos do not determine it; {source}"
    if len(cameras) > LINES_SHOWN:
        yield f"{INDENT}and {len(cameras) - LINES_SHOWN} more cameras"


def _missing_lines(run: Run, photos: Mapping[str, Any]) -> Iterator[str]:
    unusable = _photo_lines({**photos, "notes": {}})
    unregistered = run.scene.unregistered if run.scene is not None else {}
    texts = [*unusable, *(f"not placed: {name}: {reason}" for name, reason in unregistered.items())]
    yield from _first_lines("missing", texts, "photos")


def _warning_lines(run: Run) -> Iterator[str]:
    texts = [line.strip() for line in run_lines(run)]
    warnings = [text.removeprefix(WARNING) for text in texts if text.startswith(WARNING)]
    yield from _first_lines("beware", warnings, "warnings")


def _first_lines(label: str, texts: list[str], noun: str) -> Iterator[str]:
    for number, text in enumerate(texts[:LINES_SHOWN]):
        yield f"{INDENT if number else label.ljust(LABEL_COLUMNS)}{shorten(text, WARNING_WIDTH, placeholder=' ...')}"
    if len(texts) > LINES_SHOWN:
        yield f"{INDENT}and {len(texts) - LINES_SHOWN} more {noun}; -v prints them"


def _file_lines(run: Run) -> Iterator[str]:
    stage = "files" if run.mesh_path is not None else "scale"
    paths = [*([run.report_path] if run.report_path else []), *_model_files(run, stage)]
    for number, line in enumerate(file_lines(paths)):
        yield f"{INDENT if number else 'open'.ljust(LABEL_COLUMNS)}{line}"


def _video_lines(video: Mapping[str, Any]) -> Iterator[str]:
    reasons = ", ".join(f"{count} {reason}" for reason, count in video["left_out"].items())
    others = f"; not chosen: {reasons}" if reasons else ""
    yield f"video       {video['frames']} frames, {video['chosen']} chosen{others}"
    yield from (f"{INDENT}{note}" for note in video["notes"])


def _photo_lines(photos: Mapping[str, Any]) -> Iterator[str]:
    by_reason: dict[str, list[str]] = {}
    for name, reason in photos["unusable"].items():
        by_reason.setdefault(reason, []).append(name)
    for name, notes in photos["notes"].items():
        yield f"{name}: {', '.join(notes)}"
    for reason, names in by_reason.items():
        more = " (manifest.json lists all)" if len(names) > NAMES_SHOWN else ""
        yield f"left out: {list_names(names, NAMES_SHOWN)}{more}: {reason}"


def _mask_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    if summary["masks"] is not None:
        yield f"masks       {summary['masks']['photos']} of {summary['photos']['usable']} photos"


def _texture_text(mesh: Mapping[str, Any]) -> str:
    pages = " and ".join(f"{width} x {height}" for width, height in mesh.get("pages_px", ()))
    return f", texture {pages} px, JPEG quality {mesh['jpeg_quality']}" if pages else ""


def _stages(run: Run) -> dict[str, Any]:
    stages: dict[str, Any] = run.manifest.get("stages", {})
    return stages


def _counts(run: Run, stage: str) -> dict[str, Any]:
    counts: dict[str, Any] = _stages(run).get(stage, {}).get("counts", {})
    return counts


def _model_files(run: Run, stage: str) -> list[Path]:
    """Return the existing model files of a stage; the first one is the one to open."""
    names = _counts(run, stage).get("bytes", {})
    return [run.out / name for name in reversed(names) if (run.out / name).exists()]


def run_steps(run: Run, photos: Sequence[Path], out: Path | None, settings: Settings) -> list[str]:
    """Return the next commands after a run; `photos` and `out` are as on the command line."""
    again = f"sfm-app run {shlex.join(map(str, photos))}" + (f" -o {shlex.quote(str(out))}" if out is not None else "")
    if run.mesh_path is None:
        return _align_steps([(again, "continue to the model")])
    steps = [(_view_command(run), "view and measure it")]
    if settings.quality != "high":
        steps.append((f"{again} --quality high", "finer; draft: faster"))
    steps.append((f"sfm-app export {shlex.quote(str(run.out))} --format obj", "for other programs"))
    return _align_steps(steps)


def demo_steps(run: Run, scene: str) -> list[str]:
    """Return the next commands after a demo of a scene."""
    other = "statue" if scene != "statue" else "fisheye"
    return _align_steps([
        (_view_command(run), "view it"),
        (f"sfm-app demo --scene {other}", "another scene"),
        ("sfm-app run PHOTOS", "your own photos"),
    ])  # fmt: skip


def _view_command(run: Run) -> str:
    return f"sfm-app view {shlex.quote(str(run.out))}"


def _align_steps(steps: list[tuple[str, str]]) -> list[str]:
    """Return commands in a column with their purposes in a second one, or below if two columns are too wide."""
    width = max(len(command) for command, _ in steps)
    fits = LABEL_COLUMNS + width + 2 + max(len(purpose) for _, purpose in steps) <= WIDTH
    lines: list[str] = []
    for command, purpose in steps:
        lines += [f"{command:{width}}  {purpose}"] if fits else [command, f"  {purpose}"]
    return [f"{INDENT if number else 'next'.ljust(LABEL_COLUMNS)}{line}" for number, line in enumerate(lines)]
