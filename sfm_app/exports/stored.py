"""What a finished run has to export, read from its output folder; nothing is computed.

Everything that leaves here is in the frame of the export: poses, points and vertices are moved in this module only.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.models.arrays import model_arrays
from sfm_app.colmap.models.model import posed_images
from sfm_app.colmap.models.stored_model import read_model, sparse_model
from sfm_app.colmap.surface import FUSED, open_points, positions
from sfm_app.colmap.types import Reconstruction
from sfm_app.engine.stage import Products, Stage, check_undamaged, resume_hint
from sfm_app.errors import InputError
from sfm_app.geometry.similarity import Similarity
from sfm_app.pipeline import MESH, SCALE, SCENE, TEXTURE
from sfm_app.runtime.context import RunContext
from sfm_app.scale import GPS, MetricFrame, move_model
from sfm_app.scale.measuring import Distance, measure_distance
from sfm_app.scale.photo_rays import PosedPhotos
from sfm_app.types import Model, Scene, SceneArrays
from sfm_app.types.exported import PointCloud

COLORS, NORMALS = ("red", "green", "blue"), ("nx", "ny", "nz")
"""Fields of the dense cloud."""


def stored_frame(run: RunContext) -> MetricFrame:
    """Return the frame of a run's exports; that of its model where nothing is known of its size.

    Args:
        run: the finished run.
    """
    if run.workspace.manifest.record(SCALE.name) is not None:
        return Products(run)[SCALE]
    known = run.workspace.manifest.record(SCENE.name) is not None
    deviation = Products(run)[SCENE].gps_deviation if known else None
    return MetricFrame() if deviation is None else MetricFrame(deviation=deviation, source=GPS)


def export_frame(run: RunContext) -> Similarity | None:
    """Return the similarity from the frame of the run's model into that of its exports; None if they are the same."""
    frame = stored_frame(run)
    return frame.from_model if frame.changes else None


def check_finished(run: RunContext, stages: Sequence[Stage[object]], what: str, otherwise: str = "") -> None:
    """Check that stages of a run are finished.

    Args:
        run: the run.
        stages: what the export needs.
        what: what is exported, for the message.
        otherwise: what the user can do without them; for the hint.

    Raises:
        InputError: there is no run, or a stage is missing (the message names it).
    """
    place = run.workspace
    place.manifest.check_begun()
    for stage in stages:
        if place.manifest.record(stage.name) is None:
            more = f"; {otherwise}" if otherwise and place.manifest.record(SCENE.name) else ""
            message = f"{place.root} holds no {what} yet: stage `{stage.name}` is missing"
            raise InputError(message, hint=resume_hint(run) + more)


def stored_model(run: RunContext, *, points: bool = False) -> Model:
    """Read the finished model, or the points and cameras, of a run.

    Args:
        run: the finished run.
        points: whether to read the points and cameras instead of the textured surface.

    Raises:
        InputError: a stage has not run yet, or its files are missing or damaged.
    """
    if not points:
        check_finished(run, [TEXTURE], "model", "`--points` exports the points and cameras")
        return move_model(Products(run)[TEXTURE], stored_frame(run).from_model)
    check_finished(run, [SCENE], "points")
    with check_undamaged(SCENE, run):
        return move_model(sparse_model(run.workspace.sparse), stored_frame(run).from_model)


def stored_scene(run: RunContext) -> tuple[Scene, Reconstruction]:
    """Read cameras and poses, and COLMAP's model with the points.

    Args:
        run: the finished run.

    Raises:
        InputError: the scene has not been made yet, or its files are missing or damaged.
    """
    check_finished(run, [SCENE], "cameras and points")
    scene = Products(run)[SCENE]
    model = read_model(scene.model_dir, export_frame(run))
    poses = {image.name: np.asarray(image.cam_from_world().matrix(), np.float64) for image in posed_images(model)}
    return replace(scene, cam_from_world=poses), model


def stored_arrays(run: RunContext) -> SceneArrays:
    """Read poses, cameras, points and tracks as plain arrays, in the frame of exports.

    Args:
        run: the finished run.

    Raises:
        InputError: the scene has not been made yet, or its files are missing or damaged.
    """
    _, model = stored_scene(run)
    return model_arrays(model, metric=stored_frame(run).is_metric)


def stored_distance(run: RunContext, ends: NDArray[np.float64]) -> Distance:
    """Return the distance between two places in the frame of exports.

    Args:
        run: the finished run.
        ends: (2, 3) the places.

    Raises:
        ValueError: both are the same.
        InputError: the scene has not been made yet, or its files are missing or damaged.
    """
    check_finished(run, [SCENE], "camera poses")
    frame = stored_frame(run)
    a, b = frame.from_model.inverse()(ends)
    with check_undamaged(SCENE, run):
        model = PosedPhotos(run.workspace.sparse).sightlines()
    return measure_distance(a, b, model, frame.from_model.scale, frame.deviation)


def check_cloud(run: RunContext) -> Path:
    """Return the file of the dense cloud.

    Args:
        run: the finished run.

    Raises:
        InputError: the depth maps have not been fused yet, or the file is gone.
    """
    check_finished(run, [MESH], "dense cloud", "`--points` exports the sparse points")
    file = run.workspace.surface / FUSED
    if not file.exists():
        raise InputError(f"{file} is gone", f"`sfm-app run PHOTOS -o {run.workspace.root} --from mesh` makes it again")
    return file


def stored_cloud(run: RunContext) -> PointCloud:
    """Read the points that the depth maps agree on.

    Args:
        run: the finished run.

    Raises:
        InputError: the depth maps have not been fused yet, or the file of the points is gone or damaged.
    """
    file = check_cloud(run)
    with check_undamaged(MESH, run):
        records = open_points(file)
        points, colors, normals = (
            positions(records),
            np.array(_columns(records, COLORS), np.uint8),
            _columns(records, NORMALS),
        )
    frame = export_frame(run)
    if frame is not None:
        points, normals = frame(points), normals @ frame.R.T
    return PointCloud(points, colors, normals)


def _columns(records: NDArray[np.void], names: Sequence[str]) -> NDArray[np.float64]:
    """Return fields of records as the columns of an array."""
    return np.stack([records[name] for name in names], axis=1).astype(np.float64)
