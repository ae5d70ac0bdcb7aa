"""What is done with a finished run: its report, exports for other programs, and distances in it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from sfm_app.api.run import PathLike, open_run
from sfm_app.atomic_io import replace_atomically, save_files
from sfm_app.errors import ConfigError, InputError
from sfm_app.formats.exporters import CLOUD
from sfm_app.plugins import load_plugins
from sfm_app.progress import Callback, Progress
from sfm_app.runtime.workspace import Workspace
from sfm_app.scale.measuring import Distance
from sfm_app.settings import Settings


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
    from sfm_app.report.view import serve_run  # loads COLMAP

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
    from sfm_app.exports.stored import stored_model  # loads COLMAP

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
    from sfm_app.exports.finished_scene import StoredScene  # loads COLMAP
    from sfm_app.exports.stored import check_cloud
    from sfm_app.exports.targets import fill_folder

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
    from sfm_app.exports.stored import stored_distance  # loads COLMAP

    ends = np.array([a, b], np.float64)
    if ends.shape != (2, 3) or not np.isfinite(ends).all():
        raise ValueError("each place is three finite numbers")
    with open_run(Path(out), Settings(), None) as run:
        return stored_distance(run, ends)
