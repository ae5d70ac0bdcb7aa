"""depth_maps: Scene -> COLMAP dense workspace with depth and normal maps."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
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
from sfm_app.stereo import DepthTask, View, rank_neighbors
from sfm_app.stereo.sky import PhotoAreas, blank_areas, count_votes, find_skies, sky_pixels
from sfm_app.tasks import Shared, Task
from sfm_app.types import Rejected, Scene
from sfm_app.types.arrays import BoolArray, FloatArray

HINT = "take photos a step apart, sideways rather than forward, with two thirds of the view in common"

SKIES = "skies.npz"
"""File with each photo's cells of sky."""


def make(scene: Scene, run: RunContext) -> Path:
    """Make depth and normal maps in the dense workspace; raise a ReconstructionError if no photo gets one."""
    dense_dir, options = run.workspace.dense, run.settings.depth
    method, reason = run.plugins.depth_method(options.method)
    run.record(method=method.name, method_reason=reason)
    prepare(scene, dense_dir, method.name, run)
    views = dense.read_views(dense_dir)
    ranked = rank_neighbors(views, 2 * options.neighbors)  # twice as many confirm a map as make it
    with single_threaded_opencv():
        rejections = method.make(DepthTask(dense_dir, views, ranked, options, dense.DenseStore(dense_dir), run.map))
    if options.drop_sky:
        drop_skies(dense_dir, [view for view in views if dense.map_file(dense_dir, view).exists()], run)
    if dense.has_masks(dense_dir):
        run.map(Task(dense.mask_depths, dense_dir), views, "masking depth maps")
    record(dense_dir, views, rejections, run)
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


def drop_skies(dense_dir: Path, views: Sequence[View], run: RunContext) -> None:
    """Remove the depths of sky: semi-global matching continues depths along its rims. The views have a map."""
    file = dense_dir / SKIES
    if not file.exists():  # a killed run has removed depths by these skies, and would find others now
        areas = run.map(Task(find_blank_areas, dense_dir), views, "detecting the sky")
        votes = run.map(Task(_count_votes, Shared((areas, views))), range(len(views)), "comparing skies")
        cells = {str(number): sky for number, sky in enumerate(find_skies(areas, votes))}
        with replace_atomically(file) as path:
            np.savez(path, allow_pickle=False, **cells)
    skies = load_arrays(file)
    outdoor = [(number, view) for number, view in enumerate(views) if skies[str(number)].any()]
    shares = run.map(Task(_drop_sky, dense_dir, Shared(skies)), outdoor, "removing the sky") if outdoor else []
    run.record(sky=round(sum(shares) / max(len(views), 1), 3))


def find_blank_areas(dense_dir: Path, view: View) -> PhotoAreas:
    """Return the blank areas of a photo with a map."""
    return blank_areas(dense.read_gray(dense_dir, view), dense.read_depth(dense_dir, view, "geometric"))


def _count_votes(photos: Shared[tuple[Sequence[PhotoAreas], Sequence[View]]], index: int) -> FloatArray:
    return count_votes(*photos.value, index)


def _drop_sky(dense_dir: Path, skies: Shared[Mapping[str, BoolArray]], photo: tuple[int, View]) -> float:
    """Remove the depths of the sky of one photo, and return its share of the photo."""
    number, view = photo
    sky = sky_pixels(dense.read_gray(dense_dir, view), skies.value[str(number)])
    depth = dense.read_depth(dense_dir, view, "geometric")
    dense.write_depth(dense_dir, view, np.where(sky, np.float32(SKY), depth))
    return float(sky.mean())


def record(dense_dir: Path, views: Sequence[View], rejections: Sequence[Rejected | None], run: RunContext) -> None:
    """Record the photos' shares of depths and the reasons for missing maps; ReconstructionError if there is no map."""
    rejected = Counter(rejection.reason for rejection in rejections if rejection is not None)
    coverage = {
        view.name: round(float(np.mean(dense.read_depth(dense_dir, view, "geometric") > 0)), 3)
        for view, rejection in zip(views, rejections, strict=True)
        if rejection is None
    }
    run.record(depth_maps=len(coverage), rejected=dict(rejected), coverage=coverage)
    if not coverage:
        reason = rejected.most_common(1)[0][0] if rejected else "no photos"
        raise ReconstructionError(f"none of {len(views)} photos gets a depth map: {reason}", hint=HINT)


@contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """Let OpenCV use one thread per worker, since the photos are processed in parallel."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
