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
from sfm_app.fundamental.points import check_points
from sfm_app.plugins import load_plugins
from sfm_app.progress import Callback, Progress, as_progress
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import open_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.selfcal.wide_lens import LensEstimate, find_lens
from sfm_app.settings import Settings
from sfm_app.types import Calibration, CameraPairs, EpipolarFit, Intrinsics, Rejected, Scene, SceneArrays
from sfm_app.types.arrays import FloatArray

if TYPE_CHECKING:
    from sfm_app.engine.stage import Products
    from sfm_app.frame.sighted_points import Distance
    from sfm_app.frame.volumes import Volume

PathLike = str | os.PathLike[str]


def as_paths(photos: PathLike | Sequence[PathLike]) -> list[Path]:
    """Return one path or several as a list."""
    return [Path(photos)] if isinstance(photos, str | os.PathLike) else [Path(path) for path in photos]


@dataclass(frozen=True, eq=False)
class RunScene(Scene):
    """The sparse reconstruction of a run: summary, cameras, poses; points and tracks on demand."""

    out: Path = Path()

    @cached_property
    def arrays(self) -> SceneArrays:
        """Poses, cameras, points and tracks in the frame of exported files; InputError if the files are gone."""
        from sfm_app.exports import stored_arrays  # loads COLMAP

        with open_run(self.out, Settings(), None) as run:
            return stored_arrays(run)


@dataclass(frozen=True, slots=True, repr=False)
class Run:
    """The results of a finished run."""

    out: Path
    calibration: Intrinsics | None
    """K per camera group before bundle adjustment; None if the run stopped earlier."""
    scene: RunScene | None
    """Sparse reconstruction with the refined cameras; None if the run stopped earlier."""
    model_dir: Path | None
    """COLMAP's sparse model."""
    mesh_path: Path | None
    """model.glb, beside model.ply."""
    manifest: dict[str, Any]
    """manifest.json, with the stages up to the last one."""
    report_path: Path | None = None
    """report.html; None if `report` is off in the settings."""

    def __repr__(self) -> str:
        placed = len(self.scene.registered) if self.scene else 0
        made = self.mesh_path or self.model_dir
        return f"Run({str(self.out)!r}: {placed} photos placed, {made.name if made else 'no model'})"

    def picture(self) -> NDArray[np.uint8] | None:
        """Return a picture (H, W, 4) RGBA of the model, or of its points; None if no photo is placed."""
        from sfm_app.report.contents import read_scene
        from sfm_app.report.notebook import model_cutout

        with open_run(self.out, Settings(), None) as run:
            return model_cutout(read_scene(run))

    def _repr_html_(self) -> str:
        from sfm_app.report.contents import read_contents
        from sfm_app.report.notebook import run_html

        with open_run(self.out, Settings(), None) as run:
            return run_html(read_contents(run))


@contextmanager
def open_run(out: Path, settings: Settings, progress: Progress | Callback | None) -> Iterator[RunContext]:
    """Provide a run with its workers, which stop when the block ends; without `progress`, it is silent."""
    plugins = load_plugins(installed=settings.plugins)
    plugins.estimator(settings.epipolar.estimator)  # an unknown name is an error before any work
    plugins.calibrator(settings.calibration.calibrator)
    plugins.feature_method(settings.matching.features)
    place, display = Workspace(out), as_progress(progress)
    with open_executor(settings, place.cluster_files, display) as (executor, workers):
        yield RunContext(settings, place, plugins, executor, workers, display)


# Runs from photos to a mesh, or to a camera.


def reconstruct(
    photos: PathLike | Sequence[PathLike], out: PathLike, settings: Settings | None = None, *,
    first: str = "", last: str = "files", progress: Progress | Callback | None = None,
) -> Run:  # fmt: skip
    """Turn a folder of photos, or a video, into a mesh: OUT/model.ply and OUT/model.glb.

    Stages whose results in `out` are up to date are skipped.

    Args:
        photos: folder with photos of one place, a video, or several photos, folders and ZIP
            archives; nothing about the camera needs to be known.
        out: output folder; created if it does not exist.
        first: stage from which on all stages run again.
        last: last stage to run.
        progress: display of progress, or a function that is called with every `Step`; silent by default.

    Raises:
        SfmError: see `sfm_app.errors`; its message names the error, its hint a remedy.

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
        targets = (pipeline.INTRINSICS, pipeline.SCENE, pipeline.FILES)
        try:
            products = pipeline.run_stages(as_paths(photos), run, first, last, targets)
        except SfmError as err:
            if written := finish_report(run, err):
                run.progress.say(f"report of the unfinished run: {written}")
            raise
        return _as_run(run, products, last, finish_report(run))


def read_run(out: PathLike) -> Run:
    """Read the results of a run; nothing is computed.

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


def _as_run(run: RunContext, products: "Products", last: str, report: Path | None) -> Run:
    from sfm_app import pipeline

    manifest: dict[str, Any] = run.workspace.manifest.read()
    # a run of an earlier version may lack a stage
    done = [stage for stage in pipeline.PIPELINE.stages_until(last) if stage.name in manifest["stages"]]
    scene = None
    if pipeline.SCENE in done:
        found = products[pipeline.SCENE]
        scene = RunScene(**{field.name: getattr(found, field.name) for field in fields(Scene)}, out=run.workspace.root)
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
    photos: PathLike | Sequence[PathLike], settings: Settings | None = None, *,
    out: PathLike | None = None, figure: PathLike | None = None, progress: Progress | Callback | None = None,
) -> Intrinsics:  # fmt: skip
    """Find the camera matrix of a folder of photos, or of a video, without reconstructing the scene.

    Args:
        out: folder that keeps features and matches for a later run; None for a temporary one.
        figure: PNG, SVG or PDF file for the pairs' votes, the lens and the residuals; None for no figure.

    Raises:
        SfmError: see `sfm_app.errors`.

    Examples:
        >>> import sfm_app
        >>> cameras = sfm_app.calibrate_photos("photos", out="out", figure="camera.png")
        >>> cameras.identifiable
        True
    """
    from sfm_app import pipeline  # loads COLMAP
    from sfm_app.report.figures import check_figure, draw_intrinsics

    if figure is not None:
        check_figure(Path(figure))  # fail before minutes of work
    with (
        tempfile.TemporaryDirectory(prefix="sfm-app-") as scratch,
        open_run(Path(out or scratch), settings or Settings(), progress) as run,
    ):
        targets = (pipeline.MATCH_GRAPH, pipeline.VIEW_GRAPH, pipeline.INTRINSICS)
        products = pipeline.run_stages(as_paths(photos), run, last=pipeline.INTRINSICS.name, targets=targets)
        intrinsics = products[pipeline.INTRINSICS]
        if figure is not None:
            draw_intrinsics(Path(figure), products[pipeline.MATCH_GRAPH], products[pipeline.VIEW_GRAPH], intrinsics)
    return intrinsics


# Reports, exports and distances of a finished run.


def write_report(out: PathLike, compare: PathLike | None = None) -> Path:
    """Write OUT/report.html again from the products of a run; nothing is recomputed.

    Args:
        compare: output folder of another run for comparison.

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
    host: str = "",
    started: Callable[[str], None] | None = None,
    progress: Progress | Callback | None = None,
) -> None:
    """Serve the report of a run to the browsers of this machine until Ctrl-C, with its model at full size.

    Args:
        out: output folder of the run, which may have stopped at any stage.
        port: to listen on; 0 for any free port.
        host: address to listen at, for other machines: the address of the page then has a token that it needs.
        started: called with the address when the page can be opened.

    Raises:
        InputError: the folder holds no run.
        ConfigError: the port is taken, or the host is no address of this machine.

    Examples:
        >>> import sfm_app
        >>> sfm_app.view_run("out")  # doctest: +SKIP
    """
    from sfm_app.report.server import serve_run  # loads COLMAP

    with open_run(Path(out), Settings(), progress) as run:
        serve_run(run, port, started or run.progress.say, host)


def export_model(
    out: PathLike,
    file_format: str = "",
    target: PathLike | None = None,
    *,
    points: bool = False,
    box: ArrayLike | None = None,
) -> tuple[Path, ...]:
    """Write the model of a finished run in another format, or to another place; nothing is recomputed.

    Args:
        file_format: "ply", "glb", "obj", "stl", "draco", "usdz", "usd", or another that `sfm-app plugins` lists; empty
            for the suffix of `target`.
        target: file to write; None for OUT/model.FORMAT, OUT/points.FORMAT, OUT/model-draco.glb, ...
        points: export the points and cameras of the sparse reconstruction instead of the model.
        box: (2, 3) opposite corners in the frame of exported files; only what is in between is written.

    Returns:
        The files, first the one to open, then its parts.

    Raises:
        ConfigError: the format is unknown, needs a missing package, or does not fit the suffix of `target`.
        InputError: the run has no model yet, the box is empty, or the target cannot be written.
        ValueError: a corner is not three finite numbers.

    Examples:
        >>> import sfm_app
        >>> files = sfm_app.export_model("out", target="files/model.obj")
        >>> [path.name for path in files[:2]]
        ['model.obj', 'model.mtl']
    """
    from sfm_app.exports import check_parts, crop, naming_target, record_map, stored_model  # loads COLMAP

    plugins = load_plugins()
    place = Path(target) if target is not None else Path(out)
    suffix = place.suffix.removeprefix(".").lower() if target is not None and not place.is_dir() else ""
    exporter = plugins.exporter(file_format or suffix)
    if place.is_dir():  # a format with the suffix of another one gets a file of its own
        place /= ("points" if points else "model") + (f"-{exporter.name}" if exporter.name != exporter.suffix else "")
    place = _with_suffix(place, exporter.suffix)
    with open_run(Path(out), Settings(), None) as run:
        model = stored_model(run, points=points)
        model = model if box is None else crop(model, _sorted_box(box))
    files = exporter.write(model, place.stem)
    renamed = dict(zip([place.name, *list(files)[1:]], files.values(), strict=True))
    with naming_target(place):
        check_parts(place, list(renamed)[1:])
        saved = save_files(renamed, place.parent)
        record_map(run, place.parent)
        return saved


def export_scene(
    out: PathLike,
    file_format: str,
    target: PathLike | None = None,
    *,
    box: ArrayLike | None = None,
    progress: Progress | Callback | None = None,
) -> Path:
    """Write cameras, poses, points and photos of a finished run for another program; no mesh is needed.

    Args:
        file_format: "colmap", "splat", "nerfstudio", "cameras", or another that `sfm-app plugins` lists.
        target: file or folder to write; None for OUT/cameras.json, OUT/cloud.laz, OUT/export/colmap, ... An export
            replaces the folder of an earlier one.
        box: as of `export_model`, for formats of the dense cloud.

    Raises:
        ConfigError: the format is unknown, needs a missing package, does not fit the suffix of `target`, or takes no
            box.
        InputError: the run lacks data for the format, its photos are gone, or the target cannot be written or holds
            files that no export has written.

    Examples:
        >>> import sfm_app
        >>> folder = sfm_app.export_scene("out", "colmap")
        >>> sorted(path.name for path in folder.iterdir())
        ['export.json', 'images', 'sparse']
    """
    from sfm_app.exports import StoredScene, check_cloud, fill_folder, naming_target, record_map  # loads COLMAP

    exporter = load_plugins().scene_exporter(file_format)
    if box is not None and exporter.needs != CLOUD:
        raise ConfigError(f"a box does not apply to the format '{exporter.name}'", hint="omit it")
    place = Path(target) if target is not None else Path(out)
    with open_run(Path(out), Settings(), progress) as run:
        scene = StoredScene(run, None if box is None else _sorted_box(box))
        if exporter.needs == CLOUD:
            check_cloud(run)
        if not exporter.file:
            folder = place if target is not None else place / "export" / exporter.name
            with naming_target(folder), fill_folder(folder, lambda: scene.record_entries(exporter.name)) as path:
                exporter.write(scene, path)
            return folder
        file = _with_suffix(place / exporter.file if place.is_dir() else place, exporter.suffix)
        with naming_target(file), replace_atomically(file) as path:
            exporter.write(scene, path)
            record_map(run, file.parent)
        return file


def _sorted_box(box: ArrayLike) -> FloatArray:
    """Return the least and the greatest coordinates of a box by opposite corners."""
    corners = np.array(box, np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise ValueError("each corner is three finite numbers")
    return np.sort(corners, axis=0)


def _with_suffix(place: Path, suffix: str) -> Path:
    """Return the file with the suffix of its format; ConfigError if it has that of another format."""
    given = place.suffix.removeprefix(".").lower()
    if given == suffix:
        return place
    plugins = load_plugins()
    suffixes = {part.suffix for part in plugins.exporters.values()}
    if given and given in suffixes | {part.suffix for part in plugins.scene_exporters.values()}:
        raise ConfigError(f"{place.name} does not end in .{suffix}", hint=f"name it {place.stem}.{suffix}")
    return Path(f"{place}.{suffix}")


def measure_distance(out: PathLike, a: ArrayLike, b: ArrayLike) -> "Distance":
    """Return the distance between two places of a finished run, with its standard deviation.

    Args:
        a, b: (3,) x, y, z in the frame of its exported files, such as OUT/model.glb.

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


def measure_volume(out: PathLike, polygon: ArrayLike) -> "Volume":
    """Return the volumes above and below a plane within a polygon of a finished run, with standard deviations.

    The plane is the best one through the corners. The surface counts as the cameras see it along the plane's normal.

    Args:
        polygon: (N, 3) corners in order, x, y, z in the frame of its exported files, such as OUT/model.glb.

    Raises:
        ValueError: the corners are not finite or make no polygon, or there is no surface in it.
        InputError: the run has no surface yet.

    Examples:
        >>> import sfm_app
        >>> heap = sfm_app.measure_volume("out", [(0, 0, 0), (1, 0, 0), (1, 0, 1)])  # doctest: +SKIP
        >>> heap.cut, heap.cut_deviation  # doctest: +SKIP
        (0.031, 0.002)
    """
    from sfm_app.exports import stored_volume  # loads COLMAP

    corners = np.array(polygon, np.float64)
    if corners.ndim != 2 or corners.shape[1] != 3 or not np.isfinite(corners).all():
        raise ValueError("each corner is three finite numbers")
    with open_run(Path(out), Settings(), None) as run:
        return stored_volume(run, corners)


# The estimators alone, on matches and on fundamental matrices.


def estimate_fundamental(
    x1: ArrayLike, x2: ArrayLike, method: str = "lev-ransac", seed: int = 0, settings: Settings | None = None
) -> EpipolarFit | Rejected:
    """Estimate the fundamental matrix of one pair of photos from matches, many of which may be wrong.

    Args:
        x1: (N, 2) pixels in photo 1.
        x2: (N, 2) pixels in photo 2; row i matches row i of x1.
        method: name of an estimator; `sfm-app plugins` lists them.
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


def calibrate_fundamentals(  # noqa: PLR0913 - public interface, keywords only
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
    inliers = tuple(np.asarray(pair, np.float64) for pair in matches)
    pairs = replace(CameraPairs.from_Fs(Fs, size, weights), photos=tuple(photos), inliers=inliers)
    return load_plugins().calibrator(method).calibrate(pairs, (settings or Settings()).calibration, seed)


def estimate_lens(matches: Sequence[ArrayLike], size: tuple[int, int], seed: int = 0) -> LensEstimate | None:
    """Find the focal, projection and center of wide-angle and fisheye photos from the raw matches of their pairs.

    Lenses may be perspective, stereographic, equidistant, equisolid or between, with fields of view above 180 degrees.
    `is_fisheye` tells whether a wide lens explains more than a perspective lens.

    Args:
        matches: per pair of photos (N, 4) x1, y1, x2, y2 in pixels; half of them may be wrong. The estimate uses at
            most 16 pairs of 60 matches or more.
        size: (width, height) of all photos in pixels.

    Returns:
        The lens in pixels with its covariance; None if fewer than three pairs agree.

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
    arrays = [np.asarray(pair, np.float64) for pair in matches]
    if any(pair.ndim != 2 or pair.shape[1] != 4 or not np.isfinite(pair).all() for pair in arrays) or min(size) < 1:
        raise ValueError("matches must be finite arrays of shape (N, 4), and size positive")
    return find_lens(arrays, size, seed)
