"""A process of the studio: it does one job in a project, and prints its progress as lines of JSON.

    python -m sfm_app.studio.worker run PROJECT
    python -m sfm_app.studio.worker check PROJECT
    python -m sfm_app.studio.worker export PROJECT FORMAT BOX

It ends as with Ctrl-C when its input ends: with the server, or because the server wants it to.
"""

import json
import os
import shutil
import signal
import sys
import time
import zipfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sfm_app.api import export_model, export_scene, open_run, reconstruct
from sfm_app.colmap.dense import names_of_estimates
from sfm_app.errors import SfmError
from sfm_app.files import MANIFEST, replace_atomically, save_files
from sfm_app.operating_system import heed_requests_to_end, interrupt_main_thread, watch_parent
from sfm_app.pipeline import NAMES
from sfm_app.plugins import load_plugins
from sfm_app.progress import UP_TO_DATE, Step
from sfm_app.report.findings import PhotoRow, glance, photo_names, photo_rows, remarks
from sfm_app.report.page import headline, page_data, read_run, three_script
from sfm_app.report.pictures import draw_depths
from sfm_app.report.scene_view import view_points
from sfm_app.report.server import RunResources
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.cost_estimate import Plan, choose_plan, minutes_text
from sfm_app.settings import QUALITY_PRESETS, Settings
from sfm_app.studio.projects import DEPTHS, VIEW_DATA, Project

EVERY_S = 0.25
"""Seconds between two lines about the same work. Chosen by hand."""
PLANNED = NAMES[1:]
"""Stages whose costs are known once the photos are."""
SHOWN_BEFORE = (NAMES[1], "depth_maps")
"""Stages before which the page gets what is new: the photos, then the points; the model follows at the end."""
DEPTHS_EVERY_S = 2.0
"""Seconds between two looks for new depth maps. Chosen by hand."""
LATE_MIN = 0.5
"""Minutes beyond its plan from which on a stage is late. Chosen by hand."""


def say(**values: Any) -> None:
    """Print a line for the server."""
    print(json.dumps(values), flush=True)  # noqa: T201 - the server reads it


class Reporter:
    """Passes the progress of a run on, and writes the view of the page as soon as there is something to see."""

    def __init__(self, project: Project) -> None:
        self.project, self.last_s, self.begun_s = project, 0.0, 0.0
        self.plan: Plan | None = None
        self.stage, self.depths, self.looked_s = "", dict[str, int](), 0.0
        shutil.rmtree(project.view / DEPTHS, ignore_errors=True)

    def __call__(self, step: Step) -> None:
        """Pass a step on."""
        now, begins = time.monotonic(), step.stage != self.stage
        if begins:
            self.stage, self.begun_s = step.stage, now
            if step.label != UP_TO_DATE and step.stage in SHOWN_BEFORE:
                self.plan = _show(self.project)
        if step.stage == "depth_maps" and now - self.looked_s > DEPTHS_EVERY_S:
            self._show_depths()
            self.looked_s = time.monotonic()
        is_message = not begins and not step.total
        if not begins and not is_message and step.done < step.total and now - self.last_s < EVERY_S:
            return
        self.last_s = now
        more = {"message": step.label} if is_message else {"done": step.done, "total": step.total}
        say(stage=step.stage, minutes=self._minutes_left(step, now), **more)

    def _show_depths(self) -> None:
        """Write pictures of the depth maps that are new: first estimates, which other photos do not confirm yet."""
        dense, folder = self.project.out / "dense", self.project.view / DEPTHS
        for name in names_of_estimates(dense):
            picture = draw_depths(dense, name, "photometric") if name not in self.depths else None
            if picture is not None:
                save_files({f"{len(self.depths)}.jpg": picture.jpeg}, folder)
                self.depths[name] = len(self.depths)
        say(depths=len(self.depths))

    def _minutes_left(self, step: Step, now: float) -> float | None:
        """Return the planned minutes that are left; None where they are not known, or the stage takes longer."""
        if self.plan is None or step.stage not in PLANNED:
            return None
        planned, spent = self.plan.minutes([step.stage]), (now - self.begun_s) / 60
        if spent > planned + LATE_MIN:
            return None
        return self.plan.minutes(PLANNED[PLANNED.index(step.stage) + 1 :]) + max(0.0, planned - spent)


def _show(project: Project) -> Plan | None:
    """Write the view and the results of a project; return the plan of its run."""
    with open_run(project.out, Settings.from_mapping(project.settings()), None) as run:
        plan = _write_view(project, run)
    say(view=True)
    return plan


def _write_view(project: Project, run: RunContext) -> Plan | None:
    contents = read_run(run)
    resources = RunResources(contents, photo_names(contents), view_points(contents))
    rows = photo_rows(contents, None, {})
    photos = contents.photos.photos if contents.photos is not None else ()
    plans = {
        quality: choose_plan(
            photos,
            Settings.from_mapping(project.settings() | {"quality": quality}),
            run.workers,
            run.memory_mb,
            PLANNED,
        )
        for quality in (QUALITY_PRESETS if photos else ())
    }
    warnings, _ = remarks(contents)
    result = {
        "headline": headline(contents, rows),
        "problem": contents.problem,
        "warnings": warnings,
        "facts": [asdict(fact) for fact in glance(contents)],
        "photos": _photo_entries(rows, project),
        "names": resources.names,
        "minutes": {quality: minutes_text(plan.minutes(PLANNED)) for quality, plan in plans.items()},
        "has_view": resources.points is not None,
        "has_model": "files" in contents.stages,
    }
    files = {"result.json": json.dumps(result).encode("utf-8")}
    view = resources.view()
    if view is not None:
        files[VIEW_DATA] = page_data(view, rows).encode("utf-8", "replace")
        files["three.js"] = three_script().encode("utf-8")
        files |= {f"points/{number}": level for number, level in enumerate(resources.levels)}
        light = resources.find("/light.glb")
        if light is not None and isinstance(light.content, bytes):
            files["light.glb"] = light.content
    save_files(files, project.view)
    return plans.get(run.settings.quality)


def _photo_entries(rows: Sequence[PhotoRow], project: Project) -> list[dict[str, Any]]:
    """Return the rows of photos with names and files as in the project; several inputs are read by their paths."""
    inputs, entries = project.inputs(), []
    lone = inputs[0].name if len(inputs) == 1 and inputs[0].is_file() else ""
    for number, row in enumerate(rows):
        name = row.name.removeprefix(f"{project.source}/")
        file = lone or name.partition(": ")[0]  # ZIP: MEMBER
        entries.append({"name": name, "file": file, "number": number, "state": row.state, "reason": row.reason})
    return entries


def run_project(project: Project, last: str) -> None:
    """Run a project up to a stage."""
    settings = Settings.from_mapping(project.settings())
    try:
        reconstruct(project.inputs(), project.out, settings, last=last, progress=Reporter(project))
    finally:
        if (project.out / MANIFEST).exists():
            _show(project)


def export_project(project: Project, file_format: str, box: str) -> None:
    """Write the model, or what is in a box as JSON, into `exports/`: one file, or a ZIP archive of several."""
    target = project.exports / file_format
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    if file_format in load_plugins().exporters:
        files = list(export_model(project.out, file_format, target / project.name, box=json.loads(box)))
    else:
        made = export_scene(project.out, file_format, target / "scene", box=json.loads(box))
        files = sorted(path for path in made.rglob("*") if path.is_file()) if made.is_dir() else [made]
    if len(files) == 1:
        say(file=files[0].relative_to(project.exports).as_posix())
        return
    archive = project.exports / f"{project.name}-{file_format}.zip"
    with replace_atomically(archive) as draft, zipfile.ZipFile(draft, "w") as packed:
        for file in files:
            packed.write(file, file.relative_to(target))
    shutil.rmtree(target)
    say(file=archive.name)


def main(job: str, folder: str, *rest: str) -> int:
    """Do a job; the last line says how it ended."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    watch_parent(os.getppid(), interrupt_main_thread)
    project = Project(Path(folder))
    try:
        with heed_requests_to_end():
            if job == "export":
                export_project(project, *rest)
            else:
                run_project(project, NAMES[0] if job == "check" else NAMES[-1])
    except KeyboardInterrupt:
        say(end="stopped")
        return 130
    except SfmError as err:
        say(end="failed", message=str(err), hint=err.hint)
        return err.exit_code
    say(end="done")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
