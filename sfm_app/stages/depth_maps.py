"""depth_maps: Scene -> COLMAP dense workspace with depth and normal maps."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.dense import (
    DenseStore,
    MaskUndistorter,
    digest_maps,
    drop_estimates,
    has_masks,
    map_file,
    mask_depths,
    read_depth,
    read_gray,
    read_views,
    undistort,
    write_depth,
    write_fusion_views,
)
from sfm_app.colmap.wide_views import WideLens, split_wide_photos, write_model, write_views
from sfm_app.errors import ReconstructionError
from sfm_app.files import fingerprint, load_arrays, mark_finished, mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.meshing.visibility import SKY
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import Workspace
from sfm_app.stereo import DepthTask, View, rank_neighbors
from sfm_app.stereo.sky import PhotoAreas, Votes, blank_areas, count_votes, find_skies, sky_pixels
from sfm_app.tasks import Shared, Task
from sfm_app.types import Rejected, Scene

HINT = "take photos a step apart, sideways rather than forward, with two thirds of the view in common"

SKIES = "skies.npz"
"""File with the cells of each photo that show sky."""
CONFIRMING_FACTOR = 2
"""A depth map is checked against this many times as many photos as it was made from."""


def make(scene: Scene, run: RunContext) -> Path:
    """Make a depth and a normal map of every photo that has neighbors; a killed run can resume.

    Returns:
        The dense workspace.

    Raises:
        ReconstructionError: no photo gets a depth map.
        ConfigError: the method that was asked for cannot run here.
        BackendError: COLMAP failed.
    """
    dense_dir, options = run.workspace.dense, run.settings.depth
    method, why = run.plugins.depth_method(options.method)
    run.record(method=method.name, method_reason=why)
    prepare(scene, dense_dir, method.name, run)
    views = read_views(dense_dir)
    ranked = rank_neighbors(views, CONFIRMING_FACTOR * options.neighbors)
    with single_threaded_opencv():
        found = method.make(DepthTask(dense_dir, views, ranked, options, DenseStore(dense_dir), run.map))
    if options.drop_sky:
        drop_skies(dense_dir, [view for view in views if map_file(dense_dir, view).exists()], run)
    if has_masks(dense_dir):
        run.map(Task(mask_depths, dense_dir), views, "masking depth maps")
    record(dense_dir, views, found, run)
    drop_estimates(dense_dir, views)
    write_fusion_views(dense_dir, views)
    mark_finished(dense_dir)
    return dense_dir


def load(run: RunContext) -> Path:
    """Return the dense workspace."""
    return run.workspace.dense


def digest(place: Workspace) -> str:
    """Return a hash of the undistorted photos and their maps."""
    return digest_maps(place.dense)


def prepare(scene: Scene, dense_dir: Path, method: str, run: RunContext) -> None:
    """Undistort photos and masks, unless a killed run has left a workspace made from the same inputs."""
    model = [(file.name, blake2b(file.read_bytes()).hexdigest()) for file in sorted(scene.model_dir.glob("*.bin"))]
    made_from = fingerprint(run.fingerprint, method, model)
    if not resume_or_clear(dense_dir, made_from):
        largest = run.settings.depth.max_image_size_px
        lenses = split_wide_photos(scene.model_dir, largest)
        if lenses is None:
            undistort(scene.model_dir, run.workspace.photos, dense_dir, largest, run.workers, run.progress)
            if run.mask_dir is not None:
                undistort_mask = MaskUndistorter(scene.model_dir, run.mask_dir, dense_dir)
                run.map(Task(undistort_mask), read_views(dense_dir), "undistorting masks")
        else:
            look_into_photos(scene, lenses, dense_dir, run)
        mark_unfinished(dense_dir, made_from)


def look_into_photos(scene: Scene, lenses: Mapping[int, WideLens], dense_dir: Path, run: RunContext) -> None:
    """Write several perspective views of each photo of a wide lens."""
    look_into = Task(_look_into, Shared(lenses), run.workspace.photos, run.mask_dir, dense_dir)
    run.map(look_into, write_model(scene.model_dir, lenses, dense_dir), "looking into wide photos")
    run.record(views_per_photo=max(len(lens.views) for lens in lenses.values()))


def _look_into(
    lenses: Shared[Mapping[int, WideLens]], photo_dir: Path, mask_dir: Path | None, dense_dir: Path,
    photo: tuple[str, int],
) -> None:  # fmt: skip
    name, camera_id = photo
    write_views(name, lenses.value[camera_id], photo_dir, mask_dir, dense_dir)


def drop_skies(dense_dir: Path, views: Sequence[View], run: RunContext) -> None:
    """Remove the depths of what is infinitely far: semi-global matching carries depths on along its rims."""
    kept = dense_dir / SKIES
    if not kept.exists():  # a killed run has removed depths by it, and would find other skies now
        areas = run.map(Task(find_blank_areas, dense_dir), views, "looking for the sky")
        votes = run.map(Task(_count_votes, Shared((areas, views))), range(len(views)), "comparing skies")
        with replace_atomically(kept) as path:
            np.savez(
                path,
                allow_pickle=False,
                **{str(number): cells for number, cells in enumerate(find_skies(areas, votes))},
            )
    skies = load_arrays(kept)
    under_sky = [(number, view) for number, view in enumerate(views) if skies[str(number)].any()]
    shares = run.map(Task(_drop_sky, dense_dir, Shared(skies)), under_sky, "dropping the sky") if under_sky else []
    run.record(sky=round(sum(shares) / max(len(views), 1), 3))


def find_blank_areas(dense_dir: Path, view: View) -> PhotoAreas:
    """Return the blank areas of a photo."""
    return blank_areas(read_gray(dense_dir, view), read_depth(dense_dir, view, "geometric"))


def _count_votes(photos: Shared[tuple[Sequence[PhotoAreas], Sequence[View]]], index: int) -> Votes:
    return count_votes(*photos.value, index)


def _drop_sky(dense_dir: Path, skies: Shared[Mapping[str, NDArray[np.bool_]]], photo: tuple[int, View]) -> float:
    """Remove the depths of the sky of one photo, and return its share of the photo."""
    number, view = photo
    sky = sky_pixels(read_gray(dense_dir, view), skies.value[str(number)])
    depth = read_depth(dense_dir, view, "geometric")
    write_depth(dense_dir, view, np.where(sky, np.float32(SKY), depth))
    return float(sky.mean())


def record(dense_dir: Path, views: Sequence[View], found: Sequence[Rejected | None], run: RunContext) -> None:
    """Note the share of each photo that has a depth, and why photos have no depth map.

    Args:
        found: per view why it has no depth map; None where it has one.

    Raises:
        ReconstructionError: no view has a depth map.
    """
    rejected = Counter(reason.reason for reason in found if reason is not None)
    coverage = {
        view.name: round(float(np.mean(read_depth(dense_dir, view, "geometric") > 0)), 3)
        for view, reason in zip(views, found, strict=True)
        if reason is None
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
