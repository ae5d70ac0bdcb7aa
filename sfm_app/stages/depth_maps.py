"""depth_maps: Scene -> COLMAP dense workspace with depth and normal maps."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

import cv2
import numpy as np

from sfm_app.colmap import dense
from sfm_app.colmap.wide_views import WideLens, split_wide_photos, write_model, write_views
from sfm_app.errors import ReconstructionError
from sfm_app.files import fingerprint, load_arrays, mark_finished, mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.meshing.visibility import SKY
from sfm_app.runtime.context import RunContext
from sfm_app.stereo import DepthMap, DepthTask, View, rank_neighbors
from sfm_app.stereo.outlines import sharpen_outlines
from sfm_app.stereo.sky import PhotoAreas, blank_areas, compare_areas, find_skies, sky_pixels
from sfm_app.tasks import Shared, Task
from sfm_app.types import Scene
from sfm_app.types.arrays import BoolArray

HINT = "take photos a step apart, sideways rather than forward, with two thirds of the view in common"

MADE = "made.npz"
"""File with each photo's cells of sky and the reason why it has no map, written once all maps are made."""
SHARP = "sharp"
"""Empty file, written once every photo has its final map beside the first one."""


def make(scene: Scene, run: RunContext) -> Path:
    """Make depth and normal maps in the dense workspace; raise a ReconstructionError if no photo gets one."""
    dense_dir, options = run.workspace.dense, run.settings.depth
    method, reason = run.plugins.depth_method(options.method)
    run.record(method=method.name, method_reason=reason)
    prepare(scene, dense_dir, method.name, run)
    views, made = dense.read_views(dense_dir), dense_dir / MADE
    ranked = rank_neighbors(views, 2 * options.neighbors)  # twice as many confirm a map as make it
    with single_threaded_opencv():
        if not made.exists():  # a killed run has changed maps, and would find others now
            task = DepthTask(dense_dir, views, ranked, options, dense.DenseStore(dense_dir), run.map)
            reasons = ["" if rejection is None else rejection.reason for rejection in method.make(task)]
            skies = detect_skies(dense_dir, views, run) if options.drop_sky else {}
            with replace_atomically(made) as path:
                np.savez(path, allow_pickle=False, reasons=np.array(reasons, np.str_), **skies)
        found = load_arrays(made)
        finish(dense_dir, Finishing(views, [near[: options.neighbors] for near in ranked], found), run)
    record(dense_dir, views, found["reasons"].tolist(), run)
    dense.drop_estimates(dense_dir, views)
    dense.write_fusion_views(dense_dir, views)
    mark_finished(dense_dir)
    return dense_dir


def prepare(scene: Scene, dense_dir: Path, method: str, run: RunContext) -> None:
    """Undistort photos and masks, unless a killed run has left a workspace from the same inputs."""
    model = [(file.name, blake2b(file.read_bytes()).hexdigest()) for file in sorted(scene.model_dir.glob("*.bin"))]
    made_from = fingerprint(run.fingerprint, method, model)
    if not resume_or_clear(dense_dir, made_from):
        largest = run.settings.depth.max_image_size_px
        lenses = split_wide_photos(scene.model_dir, largest)
        if lenses is None:
            dense.undistort(scene.model_dir, run.workspace.photos, dense_dir, largest, run.workers, run.progress)
            if run.mask_dir is not None:
                cameras = Shared(dense.cameras_of_photos(scene.model_dir))
                task = Task(dense.undistort_mask, cameras, run.mask_dir, dense_dir)
                run.map(task, dense.read_views(dense_dir), "undistorting masks")
        else:
            project = Task(_project_wide_photo, Shared(lenses), run.workspace.photos, run.mask_dir, dense_dir)
            run.map(project, write_model(scene.model_dir, lenses, dense_dir), "projecting wide photos")
            run.record(views_per_photo=max(len(lens.views) for lens in lenses.values()))
        mark_unfinished(dense_dir, made_from)


def _project_wide_photo(
    lenses: Shared[Mapping[int, WideLens]], photo_dir: Path, mask_dir: Path | None, dense_dir: Path,
    photo: tuple[str, int],
) -> None:  # fmt: skip
    name, camera_id = photo
    write_views(name, lenses.value[camera_id], photo_dir, mask_dir, dense_dir)


def detect_skies(dense_dir: Path, views: Sequence[View], run: RunContext) -> dict[str, BoolArray]:
    """Return the cells of sky of the photos that have a map, by the number of the photo."""
    mapped = _mapped(dense_dir, views)
    areas = run.map(Task(_find_blank_areas, dense_dir), [views[number] for number in mapped], "detecting the sky")
    votes = compare_areas(areas, [views[number] for number in mapped], run.map)
    return {str(number): sky for number, sky in zip(mapped, find_skies(areas, votes), strict=True)}


def _mapped(dense_dir: Path, views: Sequence[View]) -> list[int]:
    return [number for number, view in enumerate(views) if dense.map_file(dense_dir, view).exists()]


def _find_blank_areas(dense_dir: Path, view: View) -> PhotoAreas:
    return blank_areas(dense.read_gray(dense_dir, view), dense.read_depth(dense_dir, view, "geometric"))


@dataclass(frozen=True, slots=True, eq=False)
class Finishing:
    """Input of the final maps besides the files."""

    views: Sequence[View]
    near: Sequence[Sequence[int]]
    """For each view, the indices of the photos that it is compared with."""
    skies: Mapping[str, BoolArray]
    """Cells of sky of the photos that have a map, by the number of the photo; empty if skies stay."""


def finish(dense_dir: Path, task: Finishing, run: RunContext) -> None:
    """Sharpen the outlines of all maps, and mark skies and masked pixels."""
    if not (dense_dir / SHARP).exists():
        run.map(Task(_finish_map, dense_dir, Shared(task)), _mapped(dense_dir, task.views), "sharpening outlines")
        (dense_dir / SHARP).touch()
    for view in task.views:
        dense.publish_maps(dense_dir, view)


def _finish_map(dense_dir: Path, shared: Shared[Finishing], number: int) -> None:
    task, store = shared.value, dense.DenseStore(dense_dir)
    view = task.views[number]
    if store.has(view, "final"):
        return
    maps, photo = store.read_maps(view), store.photo(view)
    # semi-global matching continues depths along the rims of skies
    sky = sky_pixels(photo, task.skies.get(str(number), np.zeros((1, 1), np.bool_)))
    maps = DepthMap(np.where(sky, np.float32(0), maps.depth), maps.normals)
    others = [task.views[other] for other in task.near[number]]
    maps = sharpen_outlines(maps, view, photo, [(other, store.photo(other)) for other in others])
    depth = np.where(sky & (maps.depth <= 0), np.float32(SKY), maps.depth)
    store.write_maps(view, DepthMap(dense.mask_depths(dense_dir, view, depth), maps.normals), "final")
    dense.drop_estimates(dense_dir, [view])


def record(dense_dir: Path, views: Sequence[View], reasons: Sequence[str], run: RunContext) -> None:
    """Record the photos' shares of depths and the reasons for missing maps; ReconstructionError if there is no map."""
    rejected, coverage, skies = Counter(reason for reason in reasons if reason), dict[str, float](), list[float]()
    for view, reason in zip(views, reasons, strict=True):
        if not reason:
            depth = dense.read_depth(dense_dir, view, "geometric")
            coverage[view.name] = round(float(np.mean(depth > 0)), 3)
            skies.append(float(np.mean(depth == SKY)))
    run.record(depth_maps=len(coverage), rejected=dict(rejected), coverage=coverage)
    if not coverage:
        reason = rejected.most_common(1)[0][0] if rejected else "no photos"
        raise ReconstructionError(f"none of {len(views)} photos gets a depth map: {reason}", hint=HINT)
    if run.settings.depth.drop_sky:
        run.record(sky=round(float(np.mean(skies)), 3))


@contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """Let OpenCV use one thread per worker, since the photos are processed in parallel."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
