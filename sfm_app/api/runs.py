"""Whole runs: from photos to a mesh, or to a camera, and finished ones read again."""

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfm_app.api.run import PathLike, Run, RunScene, open_run
from sfm_app.errors import InputError, SfmError
from sfm_app.progress import Callback, Progress
from sfm_app.settings import Settings
from sfm_app.types import Intrinsics

if TYPE_CHECKING:
    from sfm_app.engine.stage import Products
    from sfm_app.runtime.context import RunContext


def reconstruct(
    photos: PathLike, out: PathLike, settings: Settings | None = None, *,
    first: str = "", last: str = "files", progress: Progress | Callback | None = None,
) -> Run:  # fmt: skip
    """Turn a folder of photos, or a video, into a mesh: OUT/model.ply and OUT/model.glb.

    Stages whose results in `out` are up to date are skipped.

    Args:
        photos: folder with photos of one place, or a video; nothing about the camera needs to be known.
        out: output folder; created if it does not exist.
        settings: None for the defaults.
        first: redo everything from this stage on.
        last: stop after this stage.
        progress: display of progress, or a function that is called with every `Step`; silent by default.

    Raises:
        SfmError: see `sfm_app.errors`; its message and hint say what went wrong and what to do.

    Examples:
        >>> import sfm_app
        >>> run = sfm_app.reconstruct("photos", "out")
        >>> len(run.scene.registered), run.mesh_path.name
        (7, 'model.glb')
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
        return _as_run(run, products, last, finish_report(run))


def read_run(out: PathLike) -> Run:
    """Read a finished run again, up to where it has come; nothing is computed.

    Args:
        out: its output folder.

    Raises:
        InputError: it holds no run, or its files are damaged.

    Examples:
        >>> import sfm_app
        >>> run = sfm_app.read_run("out")
        >>> run.scene.arrays.cam_from_world.shape
        (7, 3, 4)
        >>> f"{run.calibration.K[0, 0] / 504:.2f} times the true focal length"  # these photos are rendered
        '1.00 times the true focal length'
    """
    from sfm_app import pipeline  # loads COLMAP
    from sfm_app.engine.stage import Products, resume_hint
    from sfm_app.report.page import REPORT

    with open_run(Path(out), Settings(), None) as run:
        run.workspace.manifest.check_begun()
        done = [name for name in pipeline.NAMES if run.workspace.manifest.record(name) is not None]
        if not done:
            raise InputError(f"no stage of the run in {out} is finished", hint=resume_hint(run))
        report = run.workspace.root / REPORT
        return _as_run(run, Products(run), done[-1], report if report.exists() else None)


def _as_run(run: "RunContext", products: "Products", last: str, report: Path | None) -> Run:
    """Return the products of a run up to a stage.

    Args:
        run: with its output folder.
        products: of its stages.
        last: name of the stage where it stopped.
        report: its report; None where there is none.
    """
    from sfm_app import pipeline

    manifest: dict[str, Any] = run.workspace.manifest.read()
    # a run of an earlier version may lack a stage
    done = [stage for stage in pipeline.PIPELINE.stages_until(last) if stage.name in manifest["stages"]]
    scene = RunScene.from_scene(products[pipeline.SCENE], run.workspace.root) if pipeline.SCENE in done else None
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
    out: PathLike | None = None, figure: PathLike | None = None, progress: Progress | Callback | None = None,
) -> Intrinsics:  # fmt: skip
    """Find the camera matrix of a folder of photos, or of a video, without reconstructing the scene.

    Args:
        photos: folder with photos, or a video.
        settings: None for the defaults.
        out: folder that keeps features and matches for a later run; None for a temporary one.
        figure: PNG, SVG or PDF file to draw the pairs' votes, the lens and the residuals into; None for no figure.
        progress: display of progress, or a function that is called with every `Step`; silent by default.

    Raises:
        SfmError: see `sfm_app.errors`.

    Examples:
        >>> import sfm_app
        >>> found = sfm_app.calibrate_photos("photos", out="out", figure="camera.png")
        >>> found.identifiable
        True
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
