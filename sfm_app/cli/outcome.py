"""What came of a run, in the few lines that a person needs: what it is, how good, what to look at, where it lies."""

from collections.abc import Iterator
from textwrap import shorten

from sfm_app.api import Run
from sfm_app.cli.display import mask_lines, photo_lines, run_lines, run_summary, video_lines, written_files
from sfm_app.cli.output import file_lines
from sfm_app.geometry.lenses.camera_models import calibration_from_model
from sfm_app.report.camera_text import SOURCES
from sfm_app.report.scale_text import scale_lines
from sfm_app.report.words import WARNING, duration_text, field_text
from sfm_app.runtime.manifest import model_triangles
from sfm_app.types.calibration import EQUIRECTANGULAR

EARLIER = 1.2
"""Seconds of all stages over those of this command from which on both are printed: stages were up to date."""
SHOWN = 3
"""Most warnings, and most photos that are not in the model, that are printed; the report has all."""
WIDTH = 160
"""Most characters of a warning."""


def outcome_lines(run: Run, seconds: float) -> list[str]:
    """Return what came of a run; `run_lines` has everything else.

    Args:
        run: up to any stage.
        seconds: that it took this time.
    """
    lines = [
        f"{headline(run)}.",
        *_input_lines(run),
        *_quality_lines(run),
        *_missing_lines(run),
        *_warning_lines(run),
        *_place_lines(run),
    ]
    whole = sum(stage["seconds"] for stage in run.manifest.get("stages", {}).values())
    earlier = f", {duration_text(whole)} with what was there" if whole > EARLIER * seconds else ""
    return [*lines, f"took        {duration_text(seconds)}{earlier}; -v prints everything that was found"]


def headline(run: Run) -> str:
    """Return what there is now, and of how many photos.

    Args:
        run: up to any stage.
    """
    if run.scene is None:
        usable = run.manifest.get("stages", {}).get("photos", {}).get("counts", {}).get("usable", 0)
        return f"The camera of {usable} photos" if run.calibration else f"{usable} usable photos"
    placed, count = len(run.scene.registered), len(run.scene.registered) + len(run.scene.unregistered)
    photos = f"all {count} photos" if placed == count else f"{placed} of {count} photos"
    triangles = model_triangles(run.manifest.get("stages", {}))
    if run.mesh_path is None:
        return f"Cameras and points of {photos}"
    return f"A model of {photos}, with {triangles:,} triangles" if triangles else f"A model of {photos}"


def _input_lines(run: Run) -> Iterator[str]:
    """Yield what was made of a video and of masks."""
    summary = run_summary(run)
    if "video" in summary:
        yield from video_lines(summary["video"])
    if summary["masks"] is not None:
        yield from mask_lines(summary["masks"], summary["photos"]["usable"])


def _quality_lines(run: Run) -> Iterator[str]:
    """Yield how exact the model and its camera are, and its unit."""
    if run.scene is not None:
        error = run.scene.mean_reprojection_px
        yield f"how exact   photos show its points to {error:.2g} px"
    yield from _camera_lines(run)
    if counts := run.manifest.get("stages", {}).get("scale", {}).get("counts"):
        yield next(iter(scale_lines(counts)))


def _camera_lines(run: Run) -> Iterator[str]:
    """Yield focal length and field of view of each camera, the refined one where there is one."""
    cameras = run.calibration.cameras if run.calibration is not None else {}
    if run.scene is not None and run.scene.cameras:  # those of photos that are not in the model do not matter
        cameras = {name: found for name, found in cameras.items() if name in run.scene.cameras}
    for name, found in list(cameras.items())[:SHOWN]:
        after = run.scene.cameras.get(name) if run.scene is not None else None
        now = calibration_from_model(after.model, after.params, (found.width, found.height)) if after else found
        deviation = (after.deviations if after else found.spread).get("fx")
        focal = f"focal {now.K[0, 0]:.1f}{f' +- {deviation:.2g}' if deviation else ''} px, "
        label = f"{name}: " if len(cameras) > 1 else ""
        yield f"camera      {label}{'' if now.projection == EQUIRECTANGULAR else focal}{field_text(now)}"
        if not found.identifiable:
            # a doubt of the pairs' that is settled would be read as one of the number above
            source = "only all photos together do"
            if after is None:
                source = f"this is {SOURCES.get(found.method, found.method)}: {found.reason}"
            yield f"            pairs of photos do not determine it, {source}"
    if len(cameras) > SHOWN:
        yield f"            and {len(cameras) - SHOWN} more cameras"


def _missing_lines(run: Run) -> Iterator[str]:
    """Yield the photos that are not in the model, with the reason."""
    left_out = list(photo_lines({**run_summary(run)["photos"], "notes": {}}))
    lost = run.scene.unregistered if run.scene is not None else {}
    said = [*left_out, *(f"not placed: {name}: {reason}" for name, reason in lost.items())]
    yield from _first_few("missing", said, "photos")


def _warning_lines(run: Run) -> Iterator[str]:
    """Yield what one should look at."""
    texts = [line.strip() for line in run_lines(run)]
    warnings = [text.removeprefix(WARNING) for text in texts if text.startswith(WARNING)]
    yield from _first_few("beware", warnings, "warnings")


def _first_few(label: str, texts: list[str], what: str) -> Iterator[str]:
    for number, text in enumerate(texts[:SHOWN]):
        yield f"{'' if number else label:12}{shorten(text, WIDTH, placeholder=' ...')}"
    if len(texts) > SHOWN:
        yield f"{'':12}and {len(texts) - SHOWN} more {what}; -v prints them"


def _place_lines(run: Run) -> Iterator[str]:
    """Yield the files to open."""
    stage = "files" if run.mesh_path is not None else "scale"
    paths = [*([run.report_path] if run.report_path else []), *written_files(run, stage)]
    for number, line in enumerate(file_lines(paths)):
        yield f"{'' if number else 'open':12}{line}"
