"""Data of the page's 3D view: the model, the points, and the placed cameras."""

import base64
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sfm_app.colmap.model import sparse_model
from sfm_app.formats.frusta import frustum_depth, scene_size
from sfm_app.formats.gltf import opengl_pose, write_glb
from sfm_app.frame.scale import move_model
from sfm_app.numerical import Json
from sfm_app.photos.panoramas import shrink
from sfm_app.products import read_texture
from sfm_app.report.contents import UNREADABLE, RunContents
from sfm_app.types import Model, PosedPhoto

logger = logging.getLogger("sfm_app")

MOST_GLB_BYTES = 16_000_000
"""Largest model in a page without a lighter one: a page of 40 MB opens on a telephone. By hand."""
LIGHT_PAGE_PX = 2048
"""Longer side of a page of texture in the lighter model; normal maps have half of it. By hand."""


def embedded_view(contents: RunContents, photos: Sequence[str]) -> Mapping[str, Json] | None:
    """Return the data of the 3D view, with model and points; None if no photo is placed."""
    points = view_points(contents)
    if points is None:
        return None
    places, colors = points.surface.vertices, points.surface.colors
    chosen = np.sort(np.random.default_rng(0).permutation(len(places))[:60_000])
    return {
        "glb": _base64(_model_bytes(contents)),
        "places": _base64(places[chosen].astype("<f4").tobytes()),
        "colors": _base64(colors[chosen].tobytes()),
    } | view_frame(contents, points, photos)


def view_points(contents: RunContents) -> Model | None:
    """Return points and cameras in the frame of exported files; None if there is no model."""
    if contents.scene is None:
        return None
    try:
        return move_model(sparse_model(contents.scene.model_dir), contents.frame.from_model)
    except UNREADABLE as err:
        logger.info("the report has no 3D view", exc_info=err)
        return None


def view_frame(contents: RunContents, points: Model, photos: Sequence[str]) -> dict[str, Json]:
    """Return the data of the 3D view besides model and points: cameras, and the scene's place and size."""
    rows = {name: number for number, name in enumerate(photos)}
    (middle, size), similarity = _bounds(points), contents.frame.from_model
    return {
        "cameras": [_camera(camera, rows.get(camera.name)) for camera in points.cameras],
        "middle": middle,
        "size": size,
        "depth": frustum_depth(np.array([camera.center for camera in points.cameras]), points.surface.vertices),
        "unit": "m" if contents.is_metric else "",
        "fromModel": {"scale": similarity.scale, "R": similarity.R.ravel().tolist(), "t": similarity.t.tolist()},
    }


def model_file(contents: RunContents) -> Path | None:
    """Return the file of the finished model; None if there is none."""
    path = contents.run.workspace.root / "model.glb"
    return path if "files" in contents.stages and path.exists() else None


def light_model(contents: RunContents) -> bytes:
    """Return the finished textured model as GLB with smaller pages of texture."""
    model = move_model(read_texture(contents.run.workspace), contents.frame.from_model)
    return write_glb(lighten(model), "model")["model.glb"]


def _model_bytes(contents: RunContents) -> bytes:
    path = model_file(contents)
    if path is None:
        return b""
    try:
        return path.read_bytes() if path.stat().st_size <= MOST_GLB_BYTES else light_model(contents)
    except UNREADABLE as err:
        logger.info("the report shows no surface", exc_info=err)
        return b""


def lighten(model: Model) -> Model:
    """Return a textured model with smaller pages."""
    if model.texture is None:
        return model
    pages = tuple(shrink(page, LIGHT_PAGE_PX / max(page.shape)) for page in model.texture.pages)
    maps = tuple(shrink(one, LIGHT_PAGE_PX // 2 / max(one.shape)) for one in model.texture.normal_maps)
    return replace(model, texture=replace(model.texture, pages=pages, normal_maps=maps))


def _bounds(points: Model) -> tuple[list[float], float]:
    places = points.surface.vertices
    if not len(places):
        places = np.array([camera.center for camera in points.cameras]).reshape(-1, 3)
    if not len(places):
        return [0.0, 0.0, 0.0], 1.0
    middle = np.median(places, axis=0)
    middle[1] = np.percentile(places[:, 1], (2.0, 98.0)).mean()  # most points may be on the ground
    return middle.tolist(), scene_size(places) or 1.0


def _camera(camera: PosedPhoto, row: int | None) -> dict[str, Any]:
    """Return pose and field of view of a photo; the matrix is by columns, of a camera that looks along -z."""
    return {
        "name": camera.name,
        "row": row,
        "matrix": opengl_pose(camera).T.ravel().round(7).tolist(),
        "across": float(camera.width / (2 * camera.K[0, 0])),
        "down": float(camera.height / (2 * camera.K[1, 1])),
    }


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
