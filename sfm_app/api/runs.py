"""Whole runs: from photos to a mesh, or to a camera."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sfm_app.errors import SfmError
from sfm_app.plugins import load_plugins
from sfm_app.progress import Progress, SilentProgress
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import open_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.types import Intrinsics, Scene

PathLike = str | os.PathLike[str]


@dataclass(frozen=True, slots=True)
class Run:
    """The results of a finished run."""

    out: Path
    calibration: Intrinsics | None
    """K per camera group as found before bundle adjustment; None when the run stopped earlier."""
    scene: Scene | None
    """The sparse reconstruction with the refined cameras; None when the run stopped earlier."""
    model_dir: Path | None
    """COLMAP's sparse model."""
    mesh_path: Path | None
    """model.glb; model.ply lies beside it."""
    manifest: dict[str, Any]
    """manifest.json, with the stages up to the one where the run stopped."""
    report_path: Path | None = None
    """report.html; None where `report` is off in the settings."""


@contextmanager
def open_run(out: Path, settings: Settings, progress: Progress | None) -> Iterator[RunContext]:
    """Provide a run with its workers, which stop when the block ends.

    Args:
        out: output folder.
        settings: of the run.
        progress: display of progress; None for silence.
    """
    plugins = load_plugins(installed=settings.plugins)
    plugins.estimator(settings.epipolar.estimator)  # unknown names are refused before any work is done
    plugins.calibrator(settings.calibration.calibrator)
    plugins.feature_method(settings.matching.features)
    place, shown = Workspace(out), progress or SilentProgress()
    with open_executor(settings, place.parcels, shown) as (executor, workers):
        yield RunContext(settings, place, plugins, executor, workers, shown)


def reconstruct(
    photos: PathLike, out: PathLike, settings: Settings | None = None, *,
    first: str = "", last: str = "files", progress: Progress | None = None,
) -> Run:  # fmt: skip
    """Turn a folder of photos, or a video, into a mesh: OUT/model.ply and OUT/model.glb.

    Stages whose results in `out` are up to date are skipped.

    Args:
        photos: folder with photos of one place, or a video; nothing about the camera needs to be known.
        out: output folder; created if it does not exist.
        settings: None for the defaults.
        first: redo everything from this stage on.
        last: stop after this stage.
        progress: display of progress; silent by default.

    Raises:
        SfmError: see `sfm_app.errors`; its message and hint say what went wrong and what to do.
    """
    from sfm_app import pipeline  # loads COLMAP, which an estimator alone does not need
    from sfm_app.report.page import finish_report

    with open_run(Path(out), settings or Settings(), progress) as run:
        run.plugins.depth_method(run.settings.depth.method)  # fail now, not halfway through the work
        wanted = (pipeline.INTRINSICS, pipeline.SCENE, pipeline.FILES)
        try:
            products = pipeline.run_stages(Path(photos), run, first, last, wanted)
        except SfmError as err:
            if written := finish_report(run, err):
                run.progress.say(f"what was found until then: {written}")
            raise
        report = finish_report(run)
        manifest = run.workspace.manifest.read()
        done = pipeline.PIPELINE.stages_until(last)
        scene = products[pipeline.SCENE] if pipeline.SCENE in done else None
        return Run(
            out=run.workspace.root,
            calibration=products[pipeline.INTRINSICS] if pipeline.INTRINSICS in done else None,
            scene=scene,
            model_dir=scene.model_dir if scene else None,
            mesh_path=products[pipeline.FILES][-1] if pipeline.FILES in done else None,
            manifest={**manifest, "stages": {stage.name: manifest["stages"][stage.name] for stage in done}},
            report_path=report,
        )


def calibrate_photos(
    photos: PathLike, settings: Settings | None = None, *,
    out: PathLike | None = None, figure: PathLike | None = None, progress: Progress | None = None,
) -> Intrinsics:  # fmt: skip
    """Find the camera matrix of a folder of photos, or of a video, without reconstructing the scene.

    Args:
        photos: folder with photos, or a video.
        settings: None for the defaults.
        out: folder that keeps features and matches for a later run; None for a temporary one.
        figure: PNG, SVG or PDF file to draw the pairs' votes, the lens and the residuals into; None for no figure.
        progress: display of progress; silent by default.

    Raises:
        SfmError: see `sfm_app.errors`.
    """
    from sfm_app import pipeline  # loads COLMAP
    from sfm_app.report import check_figure, draw_intrinsics

    if figure is not None:
        check_figure(Path(figure))  # fail before minutes of work
    with (
        tempfile.TemporaryDirectory(prefix="sfm-app-") as scratch,
        open_run(Path(out or scratch), settings or Settings(), progress) as run,
    ):
        wanted = (pipeline.MATCH_GRAPH, pipeline.VIEW_GRAPH, pipeline.INTRINSICS)
        products = pipeline.run_stages(Path(photos), run, last=pipeline.INTRINSICS.name, wanted=wanted)
        found = products[pipeline.INTRINSICS]
        if figure is not None:
            draw_intrinsics(Path(figure), products[pipeline.MATCH_GRAPH], products[pipeline.VIEW_GRAPH], found)
    return found
