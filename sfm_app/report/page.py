"""report.html: the template filled with results, style and scripts; it loads nothing else."""

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
from sfm_app.files import LOCK, replace_atomically
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
from sfm_app.runtime.workspace import Workspace

logger = logging.getLogger("sfm_app")

REPORT = "report.html"
ASSETS = Path(__file__).parent / "assets"

# three.js from the viewer in trimesh's wheel, so that this project contains no third-party code. The viewer's script is
# three.js, a loader of GLB files, and then the viewer's own page, which is cut off.

BEGIN, END, OWN_PART = "<script>", "</script>", "var camera,controls,scene"
NEEDED = ("THREE={}", "THREE.GLTFLoader=GLTFLoader")


@cache
def three_script() -> str:
    """Return three.js with its loader of GLB files as one script; empty if trimesh does not carry it."""
    packed = resources.files("trimesh") / "resources" / "templates" / "viewer.zip"
    try:
        with packed.open("rb") as file, zipfile.ZipFile(file) as archive:
            page = archive.read("viewer.html.template").decode("utf-8")
    except (OSError, KeyError, zipfile.BadZipFile):
        return ""
    script = page.partition(BEGIN)[2].rpartition(END)[0].partition(OWN_PART)[0]
    return script if all(part in script for part in NEEDED) and END not in script else ""


def finish_report(run: RunContext, problem: SfmError | None = None) -> Path | None:
    """Note how a run ended, and write its report; None if no run has begun, or another one is at work."""
    place = run.workspace
    if not (place.root / LOCK).exists():
        return None
    try:
        with place.hold_lock():
            entry = {} if problem is None else {key: getattr(problem, key) for key in ("message", "hint", "photos")}
            place.manifest.note_problem(entry)
            if not run.settings.report:
                return None
            if problem is None and _is_up_to_date(place):
                return place.root / REPORT
            run.progress.say(f"writing {REPORT}")
            return write_report(run)
    except Exception as err:  # a run does not fail for its report
        logger.info("no report", exc_info=err)
        run.progress.say(f"cannot write the report of this run: {err}")
        return None


def write_report(run: RunContext, beside_run: RunContext | None = None) -> Path:
    """Write OUT/report.html from the products of the finished stages, beside another run, and return its path."""
    contents, other = read_run(run), read_run(beside_run) if beside_run is not None else None
    path, view = run.workspace.root / REPORT, embedded_view(contents, photo_names(contents))
    parts = LargeParts(embedded_pictures(contents), view, is_served=False)
    with replace_atomically(path) as draft:
        draft.write_text(render_page(contents, parts, other), encoding="utf-8", newline="\n")
    return path


def _is_up_to_date(place: Workspace) -> bool:
    report, manifest = place.root / REPORT, place.manifest.path
    return report.exists() and manifest.exists() and report.stat().st_mtime_ns >= manifest.stat().st_mtime_ns


@dataclass(frozen=True, slots=True)
class LargeParts:
    """The large parts of the page: a page of a large model loads them from files."""

    pictures: Mapping[str, str]
    """Addresses of small pictures by photo; some may be missing."""
    view: Mapping[str, Json] | None
    """Data of the 3D view; None if no photo is placed."""
    is_served: bool
    """Whether the page loads them from its server; else they are in the page."""


def read_run(run: RunContext) -> RunContents:
    """Return the products of a run; InputError if the folder holds none."""
    run.workspace.manifest.check_begun()
    return read_contents(run)


def render_page(contents: RunContents, parts: LargeParts, other: RunContents | None = None) -> str:
    """Return the page as HTML; `other` is a run to compare with."""
    model = _read_model(contents)
    rows = photo_rows(contents, model, parts.pictures)
    warnings, others = findings.remarks(contents)
    page = _environment().get_template("page.html.jinja").render(
        title=contents.run.workspace.root.resolve().name,
        headline=headline(contents, rows),
        problem=contents.problem,
        facts=findings.glance(contents),
        compared=findings.compare(contents, other) if other is not None else None,
        beside=other.run.workspace.root.resolve().name if other is not None else "",
        warnings=warnings,
        remarks=others,
        cameras=findings.camera_tables(contents),
        surveyed=findings.survey_rows(contents.frame.surveyed),
        dropped=findings.dropped_pairs(contents),
        rows=rows,
        stages=contents.stages,
        changed=findings.changed_settings(contents),
        settings=json.dumps(contents.manifest.get("settings", {}), indent=1),
        versions=contents.manifest.get("versions", {}),
        figures=page_figures(contents, model),
        depths=depth_pictures(contents),
        depth_count=len(contents.counts("depth_maps").get("coverage", ())),
        view=parts.view is not None and bool(three_script()),
        served=parts.is_served,
        data=page_data(parts.view, rows),
        studio=False,
        three=Markup(three_script()),  # noqa: S704 - a script of an installed package, without user text
    )  # fmt: skip
    return page.encode("utf-8", "replace").decode("utf-8")  # names of files need not be text


def page_data(view: Mapping[str, Json] | None, rows: Sequence[PhotoRow]) -> Markup:
    """Return what the scripts of the page read: the 3D view and the rows of the photos."""
    photos = [{k: v for k, v in asdict(row).items() if k != "picture" and v is not None} for row in rows]
    return script_data({"view": view, "photos": photos})


def _read_model(contents: RunContents) -> ModelFigures | None:
    if contents.scene is None:
        return None
    try:
        return model_figures(contents.scene.model_dir)
    except UNREADABLE as err:
        logger.info("the report has no figures of the model", exc_info=err)
        return None


def headline(contents: RunContents, rows: Sequence[PhotoRow]) -> str:
    """Return the result of the run in one sentence."""
    if contents.problem is not None:
        return "There is no model." if contents.scene is None else "The run ended early."
    placed, count = sum(row.state == PLACED for row in rows), sum(row.state != LEFT_OUT for row in rows)
    if contents.scene is None:
        return f"{count} usable photos, not mapped yet."
    what = "A textured model" if "files" in contents.stages else "Cameras and points"
    return f"{what} from {f'all {count}' if placed == count else f'{placed} of {count}'} photos."


def script_data(value: Any) -> Markup:
    """Return plain values as JSON in a script; `<` is escaped, so that no text ends the script."""
    text = json_text(value).replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    return Markup(text)  # noqa: S704 - escaped in the line above


@cache
def _environment() -> jinja2.Environment:
    """Return the templates, which escape all texts."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(ASSETS), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.globals["correlation_text"] = correlation_text
    environment.globals["asset"] = lambda name: Markup((ASSETS / name).read_text(encoding="utf-8"))  # noqa: S704 - our files
    return environment
