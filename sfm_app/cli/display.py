"""What a person sees of a finished run, on stdout."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sfm_app.api import Run
from sfm_app.cli.output import file_lines
from sfm_app.name_lists import list_names
from sfm_app.report.camera_text import contradiction_lines, intrinsics_lines, intrinsics_summary
from sfm_app.report.scale_text import scale_lines
from sfm_app.report.scene_text import scene_lines, scene_summary
from sfm_app.runtime.manifest import model_triangles

NAMES_SHOWN = 5
"""Most files of one kind that are named; the manifest has all."""


def run_summary(run: Run) -> dict[str, Any]:
    """Return the figures of a run as plain values for --json."""
    stages = run.manifest.get("stages", {})
    counts = {name: stage["counts"] for name, stage in stages.items()}
    photos = counts.get("photos", {})
    given = {name: figures["given_cameras"] for name, figures in counts.items() if "given_cameras" in figures}
    summary: dict[str, Any] = {
        "out": str(run.out),
        "photos": {key: photos.get(key, {}) for key in ("usable", "unusable", "notes")},
        **({"video": photos["video"]} if "video" in photos else {}),
        "masks": photos.get("masks"),
        "pairs": {key: counts.get("view_graph", {}).get(key) for key in ("kept", "rejected")},
        **({"given_cameras": given} if given else {}),
        "calibration": intrinsics_summary(run.calibration) if run.calibration else None,
        "report": str(run.report_path) if run.report_path else None,
        "seconds": {name: stage["seconds"] for name, stage in stages.items()},
    }
    if run.scene:
        points = [str(path) for path in written_files(run, "scale")]
        summary["scene"] = {**scene_summary(run.scene, counts.get("scene", {})), "files": points}
    if "scale" in counts:
        summary["scale"] = counts["scale"]
    if run.mesh_path:
        files = [str(path) for path in written_files(run, "files")]
        about = {key: counts["files"][key] for key in ("pages_px", "jpeg_quality") if key in counts["files"]}
        summary["mesh"] = {"triangles": model_triangles(stages), **about, "files": files}
    return summary


def run_lines(run: Run) -> list[str]:
    """Return the figures of a run as lines of text."""
    summary, stages = run_summary(run), run.manifest.get("stages", {})
    lines = list(video_lines(summary["video"])) if "video" in summary else []
    lines.append(f"photos      {summary['photos']['usable']} usable")
    lines += [f"            {line}" for line in photo_lines(summary["photos"])]
    if summary["masks"] is not None:
        lines += mask_lines(summary["masks"], summary["photos"]["usable"])
    if summary["pairs"]["kept"] is not None:
        rejected = ", ".join(f"{count} {reason}" for reason, count in summary["pairs"]["rejected"].items())
        lines.append(
            f"pairs       {summary['pairs']['kept']} show the same scene"
            + (f"; rejected: {rejected}" if rejected else "")
        )
    if run.calibration:
        lines += intrinsics_lines(run.calibration)
        for name in ("view_graph", "intrinsics"):
            lines += [f"            {text}" for text in contradiction_lines(stages.get(name, {}).get("counts", {}))]
    if run.scene:
        lines += scene_lines(run.scene, stages.get("scene", {}).get("counts", {}))
        lines += [f"            points and cameras: {line}" for line in file_lines(written_files(run, "scale"))]
    if "scale" in summary:
        lines += scale_lines(summary["scale"])
    if run.mesh_path:
        lines.append(f"mesh        {summary['mesh']['triangles']} triangles{texture_text(summary['mesh'])}")
        lines += [f"            {line}" for line in file_lines(written_files(run, "files"))]
    if run.report_path:
        lines.append(f"report      {file_lines([run.report_path])[0]}")
    seconds = summary["seconds"]
    lines.append(
        "seconds     "
        + ", ".join(f"{name} {value:.1f}" for name, value in seconds.items())
        + f"; all {sum(seconds.values()):.1f}"
    )
    return lines


def video_lines(video: Mapping[str, Any]) -> Iterator[str]:
    """Yield which frames were chosen, and why the others were not."""
    others = ", ".join(f"{count} {reason}" for reason, count in video["left_out"].items())
    more = f"; not chosen: {others}" if others else ""
    yield f"video       {video['frames']} frames, {video['chosen']} chosen{more}"
    yield from (f"            {note}" for note in video["notes"])


def photo_lines(photos: Mapping[str, Any]) -> Iterator[str]:
    """Yield the notes on photos that are used, and the photos left out by reason."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in photos["unusable"].items():
        by_reason.setdefault(reason, []).append(name)
    for name, notes in photos["notes"].items():
        yield f"{name}: {', '.join(notes)}"
    for reason, names in by_reason.items():
        yield f"left out: {abbreviate_names(names)}: {reason}"


def mask_lines(masks: Mapping[str, Any], photos: int) -> Iterator[str]:
    """Yield how many photos have a mask, and which mask files belong to no photo.

    Args:
        masks: their figures in the manifest.
        photos: how many are used.
    """
    yield f"masks       {masks['photos']} of {photos} photos"
    if masks["unused"]:
        yield f"            without a photo that is used: {abbreviate_names(masks['unused'])}"


def abbreviate_names(names: Sequence[str]) -> str:
    """Return the first few names, and how many more there are."""
    return list_names(names, NAMES_SHOWN) + (" (all of them in manifest.json)" if len(names) > NAMES_SHOWN else "")


def texture_text(mesh: Mapping[str, Any]) -> str:
    """Return the size of the texture's pages and their JPEG quality; empty without a texture."""
    pages = " and ".join(f"{width} x {height}" for width, height in mesh.get("pages_px", ()))
    return f", texture {pages} px, JPEG of quality {mesh['jpeg_quality']}" if pages else ""


def written_files(run: Run, stage: str) -> list[Path]:
    """Return the existing model files that a stage wrote, the one to open first.

    Args:
        run: with its manifest.
        stage: name of the stage.
    """
    names = run.manifest.get("stages", {}).get(stage, {}).get("counts", {}).get("bytes", {})
    return [run.out / name for name in reversed(names) if (run.out / name).exists()]
