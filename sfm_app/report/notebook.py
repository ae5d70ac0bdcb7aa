"""A finished run as a notebook shows it: a picture of the model, and what was found."""

import base64
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.models import camera_matrix
from sfm_app.formats.frusta import center, scene_size
from sfm_app.frame.scale import move_model
from sfm_app.report.contents import UNREADABLE, RunContents
from sfm_app.report.findings import glance
from sfm_app.report.scene_view import view_points
from sfm_app.stages import texture
from sfm_app.synthetic.cameras import Camera
from sfm_app.synthetic.render import orbited_pose, render_model
from sfm_app.types import Frustum, Model

WIDTH_PX, SUPERSAMPLING = 640, 2
ASIDE_DEG = 20.0
"""Angle from the photo in the middle to the view of the picture: from the photo itself, a model looks flat."""
LEAST_FOCAL = 0.6
"""Of the width of the picture: it shows at most 80 degrees, else a plane picture is mostly stretched borders."""
POINT_PX = 2
"""Side of the square that a point is drawn as."""


def run_html(contents: RunContents) -> str:
    """Return a picture of the model and a table of what was found, as HTML.

    Args:
        contents: of the run.
    """
    rows = "".join(
        f"<tr><th style='text-align:left'>{escape(fact.name)}</th>"
        f"<td style='text-align:left'>{escape(f'{fact.value} {fact.note}'.strip())}</td></tr>"
        for fact in glance(contents)
    )
    shown = model_picture(contents)
    picture = ""
    if shown is not None:
        data = base64.b64encode(cv2.imencode(".png", shown[..., ::-1])[1].tobytes()).decode("ascii")
        picture = f"<img src='data:image/png;base64,{data}' alt='the model' width='{shown.shape[1]}'>"
    return f"<div>{picture}<table>{rows}</table></div>"


def model_picture(contents: RunContents) -> NDArray[np.uint8] | None:
    """Return a picture (H, W, 3) RGB of the model, or of its points, on white; None where no photo has a place.

    Args:
        contents: of the run.
    """
    found = model_cutout(contents)
    if found is None:
        return None
    share = found[..., 3:] / 255.0
    return np.asarray(np.round(share * found[..., :3] + (1.0 - share) * 255.0), np.uint8)


def model_cutout(contents: RunContents) -> NDArray[np.uint8] | None:
    """Return a picture (H, W, 4) RGBA of the model, or of its points, on nothing; None where no photo has a place.

    Args:
        contents: of the run.
    """
    found = view_points(contents)
    if found is None or not found.cameras:
        return None
    middle = sorted(found.cameras, key=lambda camera: camera.name)[len(found.cameras) // 2]
    camera = _scaled_camera(middle, SUPERSAMPLING * WIDTH_PX)
    model = _surface(contents)
    if model is None:
        return _draw_points(found, camera, middle.cam_from_world)
    pose = orbited_pose(middle.cam_from_world, model.surface, ASIDE_DEG)
    size = camera.width // SUPERSAMPLING, camera.height // SUPERSAMPLING
    fine = render_model(model, camera, pose)
    covered = fine.covered.astype(np.float32)[..., None]
    # colors of covered samples alone, so that none gets darker at an outline
    alpha = cv2.resize(covered, size, interpolation=cv2.INTER_AREA)[..., None]
    colors = cv2.resize(fine.colors * covered, size, interpolation=cv2.INTER_AREA) / np.maximum(alpha, 1e-6)
    return np.asarray(np.round(np.concatenate([colors, 255.0 * alpha], axis=2)), np.uint8)


def _surface(contents: RunContents) -> Model | None:
    """Return the textured surface in the frame of exported files; None where there is none, or it is damaged."""
    if "texture" not in contents.stages:
        return None
    try:
        return move_model(texture.load(contents.run), contents.frame.from_model)
    except UNREADABLE:
        return None


def _scaled_camera(photo: Frustum, width: int) -> Camera:
    """Return the camera of a photo without its lens, for a picture of some width; a wide lens shows its middle."""
    scale, height = width / photo.width, max(1, round(width / photo.width * photo.height))
    K = np.diag([scale, scale, 1.0]) @ photo.K
    if K[0, 0] < LEAST_FOCAL * width:
        K = camera_matrix(LEAST_FOCAL * width, LEAST_FOCAL * width, width / 2, height / 2)
    return Camera(K, width, height)


def _draw_points(found: Model, camera: Camera, pose: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the points as squares on nothing, the near ones over the far ones, at the size of a picture."""
    size = camera.width // SUPERSAMPLING, camera.height // SUPERSAMPLING
    picture = np.zeros((size[1], size[0], 4), np.uint8)
    X = found.surface.vertices @ pose[:, :3].T + pose[:, 3]
    least = 1e-3 * scene_size(np.array([center(one) for one in found.cameras] + [found.surface.vertices.mean(axis=0)]))
    ahead = np.flatnonzero(X[:, 2] > least)
    order = ahead[np.argsort(-X[ahead, 2], kind="stable")]
    x = X[order] @ camera.K.T
    place = np.floor(x[:, :2] / x[:, 2:] / SUPERSAMPLING)
    inside = ((place >= 0) & (place < np.array(size) - POINT_PX)).all(axis=1)
    columns, rows = place[inside].astype(np.int64).T
    colors = np.column_stack([found.surface.colors[order[inside]], np.full(len(rows), 255, np.uint8)])
    for down in range(POINT_PX):
        for right in range(POINT_PX):
            picture[rows + down, columns + right] = colors
    return picture
