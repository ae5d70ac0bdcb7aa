"""A finished run in a notebook: a picture of the model, and the figures at a glance."""

from html import escape

import cv2
import numpy as np

from sfm_app.camera.models import camera_matrix
from sfm_app.formats.frusta import scene_size
from sfm_app.frame.scale import move_model
from sfm_app.products import read_texture
from sfm_app.report.contents import UNREADABLE, RunContents, data_address
from sfm_app.report.findings import glance
from sfm_app.report.scene_view import view_points
from sfm_app.synthetic.cameras import Camera
from sfm_app.synthetic.render import PreparedModel, orbited_pose, render_model
from sfm_app.types import Model, PosedPhoto
from sfm_app.types.arrays import ByteArray, FloatArray

WIDTH_PX, SUPERSAMPLING = 640, 2
POINT_PX = 2
"""Side of the square of a point. By hand."""


def run_html(contents: RunContents) -> str:
    """Return a picture of the model and the figures at a glance as HTML."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{escape(fact.name)}</th>"
        f"<td style='text-align:left'>{escape(f'{fact.value} {fact.note}'.strip())}</td></tr>"
        for fact in glance(contents)
    )
    picture, image = model_cutout(contents), ""
    if picture is not None:
        address = data_address("image/png", cv2.imencode(".png", picture[..., [2, 1, 0, 3]])[1].tobytes())
        image = f"<img src='{address}' alt='the model' width='{picture.shape[1]}'>"
    return f"<div>{image}<table>{rows}</table></div>"


def model_cutout(contents: RunContents) -> ByteArray | None:
    """Return a transparent picture (H, W, 4) RGBA of the model, or of its points; None if no photo is placed."""
    points = view_points(contents)
    if points is None or not points.cameras:
        return None
    middle = sorted(points.cameras, key=lambda camera: camera.name)[len(points.cameras) // 2]
    camera = _scaled_camera(middle, SUPERSAMPLING * WIDTH_PX)
    model = _surface(contents)
    if model is None:
        return _draw_points(points, camera, middle.cam_from_world)
    pose = orbited_pose(middle.cam_from_world, model.surface, 20.0)  # from the photo itself, a model looks flat
    size = camera.width // SUPERSAMPLING, camera.height // SUPERSAMPLING
    fine = render_model(PreparedModel(model), camera, pose)
    covered = fine.covered.astype(np.float32)[..., None]
    # only covered samples count, so that outlines do not get darker
    alpha = cv2.resize(covered, size, interpolation=cv2.INTER_AREA)[..., None]
    colors = cv2.resize(fine.colors * covered, size, interpolation=cv2.INTER_AREA) / np.maximum(alpha, 1e-6)
    return np.asarray(np.round(np.concatenate([colors, 255.0 * alpha], axis=2)), np.uint8)


def _surface(contents: RunContents) -> Model | None:
    if "texture" not in contents.stages:
        return None
    try:
        return move_model(read_texture(contents.run.workspace), contents.frame.from_model)
    except UNREADABLE:
        return None


def _scaled_camera(photo: PosedPhoto, width: int) -> Camera:
    """Return a pinhole camera at a photo's pose, for a picture of this width; a wide lens shows its middle."""
    scale, height = width / photo.width, max(1, round(width / photo.width * photo.height))
    K = np.diag([scale, scale, 1.0]) @ photo.K
    least = 0.6 * width  # 80 degrees: the borders of a wider plane picture are stretched. By hand
    if K[0, 0] < least:
        K = camera_matrix(least, least, width / 2, height / 2)
    return Camera(K, width, height)


def _draw_points(model: Model, camera: Camera, pose: FloatArray) -> ByteArray:
    """Return the points as opaque squares, near ones over far ones, at the size of a picture."""
    size = camera.width // SUPERSAMPLING, camera.height // SUPERSAMPLING
    picture = np.zeros((size[1], size[0], 4), np.uint8)
    X = model.surface.vertices @ pose[:, :3].T + pose[:, 3]
    middle = model.surface.vertices.mean(axis=0)
    least = 1e-3 * scene_size(np.array([photo.center for photo in model.cameras] + [middle]))
    ahead = np.flatnonzero(X[:, 2] > least)
    order = ahead[np.argsort(-X[ahead, 2], kind="stable")]
    x = X[order] @ camera.K.T
    place = np.floor(x[:, :2] / x[:, 2:] / SUPERSAMPLING)
    inside = ((place >= 0) & (place < np.array(size) - POINT_PX)).all(axis=1)
    columns, rows = place[inside].astype(np.int64).T
    colors = np.column_stack([model.surface.colors[order[inside]], np.full(len(rows), 255, np.uint8)])
    for down in range(POINT_PX):
        for right in range(POINT_PX):
            picture[rows + down, columns + right] = colors
    return picture
