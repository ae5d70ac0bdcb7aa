"""The public functions: whole runs, finished runs, and the estimators alone."""

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfm_app.errors import ConfigError, InputError, SfmError
from sfm_app.files import replace_atomically, save_files
from sfm_app.formats.exporters import CLOUD
from sfm_app.frame.sighted_points import Distance
from sfm_app.fundamental.points import check_points
from sfm_app.plugins import load_plugins
from sfm_app.progress import Callback, Progress, as_progress
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import open_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.selfcal.wide_lens import LensEstimate, find_lens
from sfm_app.settings import Settings
from sfm_app.types import Calibration, CameraPairs, EpipolarFit, Intrinsics, Rejected, Scene, SceneArrays

# A finished run in Python: its products, its scene as arrays, and how a notebook shows it.

PathLike = str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class RunScene(Scene):
    """The sparse reconstruction of a run: summary, cameras, poses; points and tracks once they are asked for."""

    out: Path = Path()
    """Output folder of the run."""

    @cached_property
    def arrays(self) -> SceneArrays:
        """Poses, cameras, points and tracks in the frame of exported files; InputError where the files are gone."""
        from sfm_app.exports import stored_arrays  # loads COLMAP

        with open_run(self.out, Settings(), None) as run:
            return stored_arrays(run)

    @classmethod
    def from_scene(cls, scene: Scene, out: Path) -> "RunScene":
        """Return a scene with the folder that its arrays are read from.

        Args:
            scene: product of the stage.
            out: output folder of the run.
        """
        return cls(**{field.name: getattr(scene, field.name) for field in fields(Scene)}, out=out)


@dataclass(frozen=True, slots=True, repr=False)
class Run:
    """The results of a finished run."""

    out: Path
    calibration: Intrinsics | None
    """K per camera group as found before bundle adjustment; None when the run stopped earlier."""
    scene: RunScene | None
    """The sparse reconstruction with the refined cameras; None when the run stopped earlier."""
    model_dir: Path | None
    """COLMAP's sparse model."""
    mesh_path: Path | None
    """model.glb; model.ply lies beside it."""
    manifest: dict[str, Any]
    """manifest.json, with the stages up to the one where the run stopped."""
    report_path: Path | None = None
    """report.html; None where `report` is off in the settings."""

    def __repr__(self) -> str:
        placed = len(self.scene.registered) if self.scene else 0
        made = self.mesh_path or self.model_dir
        return f"Run({str(self.out)!r}: {placed} photos placed, {made.name if made else 'no model'})"

    def picture(self) -> NDArray[np.uint8] | None:
        """Return a picture (H, W, 4) RGBA of the model, or of its points; None where no photo has a place."""
        from sfm_app.report.contents import read_scene
        from sfm_app.report.notebook import model_cutout

        with open_run(self.out, Settings(), None) as run:
            return model_cutout(read_scene(run))

    def _repr_html_(self) -> str:
        """Return a picture of the model and a table of what was found, for notebooks."""
        from sfm_app.report.contents import read_contents
        from sfm_app.report.notebook import run_html

        with open_run(self.out, Settings(), None) as run:
            return run_html(read_contents(run))


@contextmanager
def open_run(out: Path, settings: Settings, progress: Progress | Callback | None) -> Iterator[RunContext]:
    """Provide a run with its workers, which stop when the block ends.

    Args:
        out: output folder.
        settings: of the run.
        progress: display of progress, or a function that is called with every `Step`; None for silence.
    """
    plugins = load_plugins(installed=settings.plugins)
    plugins.estimator(settings.epipolar.estimator)  # unknown names are refused before any work is done
    plugins.calibrator(settings.calibration.calibrator)
    plugins.feature_method(settings.matching.features)
    place, shown = Workspace(out), as_progress(progress)
    with open_executor(settings, place.cluster_files, shown) as (executor, workers):
        yield RunContext(settings, place, plugins, executor, workers, shown)


# Whole runs: from photos to a mesh, or to a camera, and finished ones read again.

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


# What is done with a finished run: its report, exports for other programs, and distances in it.


def write_report(out: PathLike, compare: PathLike | None = None) -> Path:
    """Write OUT/report.html again, from what a run has left; nothing is computed again.

    Args:
        out: output folder of the run.
        compare: that of another run, to be set beside it; None for none.

    Raises:
        InputError: a folder holds no run.

    Examples:
        >>> import sfm_app
        >>> sfm_app.write_report("out").name
        'report.html'
    """
    from sfm_app.report import page  # loads COLMAP

    with open_run(Path(out), Settings(), None) as run:
        return page.write_report(run, replace(run, workspace=Workspace(Path(compare))) if compare is not None else None)


def view_run(
    out: PathLike,
    *,
    port: int = 0,
    started: Callable[[str], None] | None = None,
    progress: Progress | Callback | None = None,
) -> None:
    """Serve the report of a run to the browsers of this machine until Ctrl-C, with its model at full size.

    Args:
        out: output folder of the run, which may have stopped at any stage.
        port: to listen on; 0 for any that is free.
        started: called with the address of the page once it can be opened.
        progress: display of progress, or a function that is called with every `Step`; silent by default.

    Raises:
        InputError: the folder holds no run.
        ConfigError: the port is taken.

    Examples:
        >>> import sfm_app
        >>> sfm_app.view_run("out")  # doctest: +SKIP
    """
    from sfm_app.report.server import serve_run  # loads COLMAP

    with open_run(Path(out), Settings(), progress) as run:
        serve_run(run, port, started or run.progress.say)


def export_model(
    out: PathLike, file_format: str = "", target: PathLike | None = None, *, points: bool = False
) -> tuple[Path, ...]:
    """Write the model of a finished run in another format, or to another place; nothing is recomputed.

    Args:
        out: output folder of the run.
        file_format: "ply", "glb", "obj", "stl", "draco", "usdz", "usd", or another that `sfm-app plugins` lists; empty
            for the suffix of `target`.
        target: file to write; None for OUT/model.FORMAT, OUT/points.FORMAT, OUT/model-draco.glb, ...
        points: export the points and cameras of the sparse reconstruction instead of the model.

    Returns:
        The files, the one to open first, then those that it refers to.

    Raises:
        ConfigError: no format has that name, a package that it needs is missing, or the suffix of `target` belongs to
            another one.
        InputError: the run has not made the model yet, or the target cannot be written.

    Examples:
        >>> import sfm_app
        >>> files = sfm_app.export_model("out", target="files/model.obj")
        >>> [path.name for path in files[:2]]
        ['model.obj', 'model.mtl']
    """
    from sfm_app.exports import stored_model  # loads COLMAP

    plugins = load_plugins()
    place = Path(target) if target is not None else Path(out)
    named = place.suffix.removeprefix(".").lower() if target is not None and not place.is_dir() else ""
    exporter = plugins.exporter(file_format or named)
    if place.is_dir():  # a format with the suffix of another one leaves that one's file alone
        place /= ("points" if points else "model") + (f"-{exporter.name}" if exporter.suffix else "")
    place = _with_suffix(place, exporter.ending)
    with open_run(Path(out), Settings(), None) as run:
        model = stored_model(run, points=points)
    files = exporter.write(model, place.stem)
    named_so = dict(zip([place.name, *list(files)[1:]], files.values(), strict=True))
    with _saying_where(place):
        return save_files(named_so, place.parent)


def export_scene(
    out: PathLike, file_format: str, target: PathLike | None = None, *, progress: Progress | Callback | None = None
) -> Path:
    """Write cameras, poses, points and photos of a finished run for another program; no mesh is needed.

    Args:
        out: output folder of the run.
        file_format: "colmap", "splat", "nerfstudio", "cameras", or another that `sfm-app plugins` lists.
        target: file or folder to write; None for OUT/cameras.json, OUT/cloud.laz, OUT/export/colmap, ... A folder that
            an earlier export has written is replaced.
        progress: display of progress, or a function that is called with every `Step`; silent by default.

    Returns:
        The file or the folder.

    Raises:
        ConfigError: no format has that name, a package that it needs is missing, or the suffix of `target` belongs to
            another one.
        InputError: the run has not made what the format needs, its photos are gone, or the target cannot be written
            or holds files that no export has written.

    Examples:
        >>> import sfm_app
        >>> folder = sfm_app.export_scene("out", "colmap")
        >>> sorted(path.name for path in folder.iterdir())
        ['export.json', 'images', 'sparse']
    """
    from sfm_app.exports import (
        StoredScene,  # loads COLMAP
        check_cloud,
        fill_folder,
    )

    exporter = load_plugins().scene_exporter(file_format)
    place = Path(target) if target is not None else Path(out)
    with open_run(Path(out), Settings(), progress) as run:
        scene = StoredScene(run)
        if exporter.needs == CLOUD:
            check_cloud(run)
        if not exporter.file:
            folder = place if target is not None else place / "export" / exporter.name
            with _saying_where(folder), fill_folder(folder, lambda: scene.record_entries(exporter.name)) as path:
                exporter.write(scene, path)
            return folder
        file = _with_suffix(place / exporter.file if place.is_dir() else place, exporter.ending)
        with _saying_where(file), replace_atomically(file) as path:
            exporter.write(scene, path)
        return file


def _with_suffix(place: Path, suffix: str) -> Path:
    """Return the file with the suffix of its format; ConfigError where it has that of another one."""
    named = place.suffix.removeprefix(".").lower()
    if named == suffix:
        return place
    plugins = load_plugins()
    known = {part.ending for part in plugins.exporters.values()}
    if named and named in known | {part.ending for part in plugins.scene_exporters.values()}:
        raise ConfigError(f"{place.name} does not end in .{suffix}", hint=f"name it {place.stem}.{suffix}")
    return Path(f"{place}.{suffix}")


@contextmanager
def _saying_where(place: Path) -> Iterator[None]:
    """Turn errors of the file system into one that names the target of an export."""
    try:
        yield
    except OSError as err:
        raise InputError(f"cannot write {place}: {err.strerror or err}", hint="name another place with -o") from err


def measure_distance(out: PathLike, a: ArrayLike, b: ArrayLike) -> Distance:
    """Return the distance between two places of a finished run, with its standard deviation.

    Args:
        out: output folder of the run.
        a: (3,) x, y, z in the frame of its exported files, such as OUT/model.glb.
        b: the other place.

    Raises:
        ValueError: a place is not three finite numbers, or both are the same.
        InputError: the run has no camera poses yet.

    Examples:
        >>> import sfm_app
        >>> length = sfm_app.measure_distance("out", (0, 0, 0), (1, 0, 0))
        >>> round(length.value, 3), length.metric
        (1.0, False)
    """
    from sfm_app.exports import stored_distance  # loads COLMAP

    ends = np.array([a, b], np.float64)
    if ends.shape != (2, 3) or not np.isfinite(ends).all():
        raise ValueError("each place is three finite numbers")
    with open_run(Path(out), Settings(), None) as run:
        return stored_distance(run, ends)


# The estimators alone, on matches and on fundamental matrices.


def estimate_fundamental(
    x1: ArrayLike, x2: ArrayLike, method: str = "lev-ransac", seed: int = 0, settings: Settings | None = None
) -> EpipolarFit | Rejected:
    """Estimate the fundamental matrix of one pair of photos from matches, many of which may be wrong.

    Args:
        x1: (N, 2) pixels in photo 1.
        x2: (N, 2) pixels in photo 2; row i matches row i of x1.
        method: name of an estimator; `sfm-app plugins` lists them.
        seed: same seed, same result.
        settings: their table `epipolar` holds the threshold and the limits.

    Returns:
        EpipolarFit, or Rejected (falsy) with the reason when the matches support no geometry.

    Raises:
        ValueError: shapes differ or values are not finite.
        ConfigError: no estimator has that name.

    Examples:
        >>> import sfm_app
        >>> from sfm_app.synthetic.correspondences import PairOptions, make_pair
        >>> pair = make_pair(PairOptions(outliers=0.5), seed=1)
        >>> fit = sfm_app.estimate_fundamental(pair.x1, pair.x2)
        >>> bool(fit), fit.F.shape, fit.degeneracy
        (True, (3, 3), '')
        >>> fit.inliers[pair.is_inlier].mean() > 0.8
        np.True_
    """
    options = (settings or Settings()).epipolar
    return load_plugins().estimator(method).fit(*check_points(x1, x2), options, seed)


def calibrate_fundamentals(
    Fs: ArrayLike, size: tuple[int, int], method: str = "zero-curves", *,
    weights: ArrayLike | None = None, matches: Sequence[ArrayLike] = (), photos: Sequence[tuple[int, int]] = (),
    seed: int = 0, settings: Settings | None = None,
) -> Calibration:  # fmt: skip
    """Find the camera matrix that a set of fundamental matrices shares.

    Args:
        Fs: (P, 3, 3) fundamental matrices in pixels, of pairs taken with one camera.
        size: (width, height) of the photos in pixels.
        method: name of a calibrator; `sfm-app plugins` lists them.
        weights: (P,) > 0, weight of each matrix; None for equal weights.
        matches: per matrix (N, 4) x1, y1, x2, y2 in pixels, the matches behind it; they reveal the lens distortion and
            the accuracy of each matrix.
        photos: per matrix the ids of its two photos.
        seed: same seed, same result.
        settings: their table `calibration` holds the limits.

    Raises:
        ValueError: shapes are wrong or values are not finite.
        ConfigError: no calibrator has that name.

    Examples:
        >>> import sfm_app
        >>> from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
        >>> tracks = make_tracks(TrackOptions(), seed=1)
        >>> camera = sfm_app.calibrate_fundamentals(tracks.F, tracks.size)
        >>> camera.identifiable, f"{camera.K[0, 0] / tracks.K[0, 0, 0]:.2f} times the true focal length"
        (True, '1.00 times the true focal length')
    """
    found = [np.asarray(pair, np.float64) for pair in matches]
    pairs = replace(CameraPairs.from_Fs(Fs, size, weights), photos=tuple(photos), inliers=tuple(found))
    return load_plugins().calibrator(method).calibrate(pairs, (settings or Settings()).calibration, seed)


def estimate_lens(matches: Sequence[ArrayLike], size: tuple[int, int], seed: int = 0) -> LensEstimate | None:
    """Find the focal, projection and center of wide-angle and fisheye photos from the raw matches of their pairs.

    It knows perspective, stereographic, equidistant and equisolid lenses and all between, with fields of view up to
    more than 180 degrees. `is_fisheye` says whether any of them explains more than a perspective lens.

    Args:
        matches: per pair of photos (N, 4) x1, y1, x2, y2 in pixels; half of them may be wrong. At most 16 pairs with 60
            matches or more are used.
        size: (width, height) of all photos in pixels.
        seed: same seed, same result.

    Returns:
        The lens in pixels with its covariance; None where fewer than three pairs agree on one.

    Raises:
        ValueError: shapes are wrong or values are not finite.

    Examples:
        >>> import numpy as np, sfm_app
        >>> from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
        >>> tracks = make_tracks(TrackOptions(), seed=1)
        >>> matches = [np.hstack([pair.x1, pair.x2]) for pair in list(tracks.pairs.values())[:3]]
        >>> sfm_app.estimate_lens(matches, tracks.size).is_fisheye
        False
    """
    found = [np.asarray(pair, np.float64) for pair in matches]
    if any(pair.ndim != 2 or pair.shape[1] != 4 or not np.isfinite(pair).all() for pair in found) or min(size) < 1:
        raise ValueError("matches must be finite arrays of shape (N, 4), and size positive")
    return find_lens(found, size, seed)
