"""Write the page: the template filled with what was found, style and scripts put in, nothing to be loaded."""

import json
import logging
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from sfm_app.colmap.model import ModelFigures, model_figures
from sfm_app.errors import SfmError
from sfm_app.files import replace_atomically
from sfm_app.numerical import Json, json_text
from sfm_app.report import findings
from sfm_app.report.contents import UNREADABLE, RunContents, read_contents
from sfm_app.report.findings import (
    LEFT_OUT,
    PLACED,
    PhotoRow,
    correlation_text,
    embedded_pictures,
    photo_names,
    photo_rows,
)
from sfm_app.report.pictures import depth_pictures, page_figures
from sfm_app.report.scene_view import embedded_view
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import LOCK, Workspace

# three.js, out of the viewer that trimesh's wheel carries, so that no third-party code lies in this project.
#
# The script of that viewer has three.js with a loader of GLB files, and then its own page, which is cut off.

BEGIN, END, OWN_PART = "<script>", "</script>", "var camera,controls,scene"
NEEDED = ("THREE={}", "THREE.GLTFLoader=GLTFLoader")
"""Without these the wheel carries something else."""


@cache
def three_script() -> str:
    """Return three.js with its loader of GLB files as one script; empty where trimesh does not carry it."""
    packed = resources.files("trimesh") / "resources" / "templates" / "viewer.zip"
    try:
        with packed.open("rb") as file, zipfile.ZipFile(file) as archive:
            page = archive.read("viewer.html.template").decode("utf-8")
    except (OSError, KeyError, zipfile.BadZipFile):
        return ""
    script = page.partition(BEGIN)[2].rpartition(END)[0].partition(OWN_PART)[0]
    return script if all(part in script for part in NEEDED) and END not in script else ""


logger = logging.getLogger("sfm_app")

REPORT = "report.html"
ASSETS = Path(__file__).parent / "assets"


def finish_report(run: RunContext, problem: SfmError | None = None) -> Path | None:
    """Note how a run ended, and write its report; no failure in it ends the run.

    Args:
        run: with its output folder.
        problem: that ended the run; None where it went to its end.

    Returns:
        The report; None where there is none: no run has begun in the folder, or another one is at work in it.
    """
    place = run.workspace
    if not (place.root / LOCK).exists():
        return None
    try:
        with place.hold_lock():
            place.manifest.note_problem({} if problem is None else _as_plain(problem))
            if not run.settings.report:
                return None
            if problem is None and _is_up_to_date(place):
                return place.root / REPORT
            run.progress.say(f"writing {REPORT}")
            return write_report(run)
    except Exception as err:  # a run does not fail for its report
        logger.info("no report", exc_info=err)
        run.progress.say(f"there is no report of this run: {err}")
        return None


def write_report(run: RunContext, beside_run: RunContext | None = None) -> Path:
    """Write OUT/report.html from what the finished stages of a run have left, and return its path.

    Args:
        run: with its output folder.
        beside_run: another run to compare it with; None for none.

    Raises:
        InputError: a folder holds no run.
    """
    contents, other = read_run(run), read_run(beside_run) if beside_run is not None else None
    path = run.workspace.root / REPORT
    with replace_atomically(path) as beside:
        beside.write_text(render_page(contents, embed_parts(contents), other), encoding="utf-8", newline="\n")
    return path


def _is_up_to_date(place: Workspace) -> bool:
    """Return whether the report was written after the last change of the manifest."""
    report, manifest = place.root / REPORT, place.manifest.path
    return report.exists() and manifest.exists() and report.stat().st_mtime_ns >= manifest.stat().st_mtime_ns


def _as_plain(problem: SfmError) -> dict[str, Any]:
    return {"message": problem.message, "hint": problem.hint, "photos": problem.photos}


@dataclass(frozen=True, slots=True)
class LargeParts:
    """The parts of the page that are too large for one file where the model is large."""

    pictures: Mapping[str, str]
    """Addresses of small pictures, by name of the photo; may lack some."""
    view: Mapping[str, Json] | None
    """What the 3D view needs; None where no photo has a place."""
    is_served: bool
    """Whether they are loaded from where the page is from; else they are in the page, and it may load nothing."""


def embed_parts(contents: RunContents) -> LargeParts:
    """Return the large parts as data in the page.

    Args:
        contents: of the run.
    """
    return LargeParts(embedded_pictures(contents), embedded_view(contents, photo_names(contents)), is_served=False)


def read_run(run: RunContext) -> RunContents:
    """Return what a run has left.

    Args:
        run: with its output folder.

    Raises:
        InputError: the folder holds no run.
    """
    run.workspace.manifest.check_begun()
    return read_contents(run)


def render_page(contents: RunContents, parts: LargeParts, other: RunContents | None = None) -> str:
    """Return the page as HTML.

    Args:
        contents: of the run.
        parts: pictures and view of this run.
        other: what another run has left, to compare it with.
    """
    model = _read_model(contents)
    rows = photo_rows(contents, model, parts.pictures)
    view = parts.view
    warnings, others = findings.remarks(contents)
    return _environment().get_template("page.html.jinja").render(
        title=contents.run.workspace.root.resolve().name,
        headline=headline(contents, rows),
        problem=contents.problem,
        facts=findings.glance(contents),
        compared=findings.compare(contents, other) if other is not None else None,
        warnings=warnings,
        remarks=others,
        cameras=findings.camera_tables(contents),
        dropped=findings.dropped_pairs(contents),
        rows=rows,
        stages=findings.stage_rows(contents),
        changed=findings.changed_settings(contents),
        settings=json.dumps(contents.manifest.get("settings", {}), indent=1),
        versions=contents.manifest.get("versions", {}),
        figures=page_figures(contents, model),
        depths=depth_pictures(contents),
        view=view is not None and bool(three_script()),
        served=parts.is_served,
        data=script_data({"view": view, "photos": [_photo_data(row) for row in rows]}),
        three=Markup(three_script()),  # noqa: S704 - a script of an installed package, without user text
    )  # fmt: skip


def _read_model(contents: RunContents) -> ModelFigures | None:
    """Return None where there is no model, or it cannot be read."""
    if contents.scene is None:
        return None
    try:
        return model_figures(contents.scene.model_dir)
    except UNREADABLE as err:
        logger.info("the report has no figures of the model", exc_info=err)
        return None


def headline(contents: RunContents, rows: Sequence[PhotoRow]) -> str:
    """Return what came of the run, in one sentence.

    Args:
        contents: of the run.
        rows: of all photos.
    """
    if contents.problem is not None:
        return "There is no model." if contents.scene is None else "The run ended early."
    placed, count = sum(row.state == PLACED for row in rows), sum(row.state != LEFT_OUT for row in rows)
    if contents.scene is None:
        return f"{count} usable photos, not mapped yet."
    what = "A textured model" if "files" in contents.stages else "Cameras and points"
    return f"{what} from {f'all {count}' if placed == count else f'{placed} of {count}'} photos."


def _photo_data(row: PhotoRow) -> dict[str, Any]:
    return {key: value for key, value in asdict(row).items() if key != "picture" and value is not None}


def script_data(value: Any) -> Markup:
    """Return plain values as JSON that no text in them can end: `<` is escaped."""
    text = json_text(value).replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    return Markup(text)  # noqa: S704 - escaped in the line above


@cache
def _environment() -> jinja2.Environment:
    """Return the templates, which escape every text that is put into them."""
    found = jinja2.Environment(
        loader=jinja2.FileSystemLoader(ASSETS), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    found.globals["correlation_text"] = correlation_text
    found.globals["asset"] = lambda name: Markup((ASSETS / name).read_text(encoding="utf-8"))  # noqa: S704 - our files
    return found
