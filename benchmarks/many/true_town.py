"""A dense workspace of the town's photos with their true poses, without the stages that would find them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import pycolmap
from sfm_app.geometry.triangles import cluster
from sfm_app.synthetic.cameras import Camera, Views
from sfm_app.synthetic.render import cast_rays, ray_caster
from sfm_app.types import CameraModel, PosedPhoto, Scene
from sfm_app.types.scene import camera_center

FloatArray = NDArray[np.float64]
POINTS_PER_PHOTO = 150
"""Random points of the surface that each photo adds; most are seen by a dozen others. Chosen by hand."""
REACH_M = 60.0
"""Distance up to which a photo observes points. Chosen by hand."""


def true_scene(folder: Path, camera: Camera, views: Views, vertices: FloatArray, faces: NDArray[np.int64]) -> Scene:
    """Write COLMAP's model of photos with true poses and points, and return the scene.

    Args:
        folder: where the model goes.
        camera: of all photos.
        views: the photos.
        vertices, faces: the true surface.
    """
    seen_in, points = _observations(camera, views, vertices, faces)
    model = pycolmap.Reconstruction()
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    params = [fx, fy, cx, cy, camera.radial, 0.0, 0.0, 0.0]
    shape = {"model": "OPENCV", "width": camera.width, "height": camera.height, "params": params}
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **shape))
    for number, (name, pose) in enumerate(views.cam_from_world.items(), start=1):
        image = pycolmap.Image(image_id=number, name=name, camera_id=1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    tracks = [pycolmap.Track() for _ in points]
    for number, (pixels, which) in enumerate(seen_in, start=1):
        model.images[number].points2D = pycolmap.Point2DList([pycolmap.Point2D(at) for at in pixels])
        for place, point in enumerate(which):
            tracks[point].add_element(number, place)
    for point, track in zip(points, tracks, strict=True):
        if len(track.elements) >= 2:
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    folder.mkdir(parents=True)
    model.write(folder)
    lens = CameraModel("OPENCV", tuple(params), camera.K, camera.width, camera.height)
    poses = {name: np.asarray(pose, np.float64) for name, pose in views.cam_from_world.items()}
    return Scene(folder, poses, {}, {"camera": lens}, len(points), 0, 0.0, dict.fromkeys(poses, "camera"))


def _observations(
    camera: Camera, views: Views, vertices: FloatArray, faces: NDArray[np.int64]
) -> tuple[list[tuple[FloatArray, NDArray[np.int64]]], FloatArray]:
    """Return per photo the pixels and numbers of the points that it sees, and all points (N, 3)."""
    surface, rng, points = ray_caster(vertices, faces), np.random.default_rng(0), []
    inverse = np.linalg.inv(camera.K)
    for pose in views.cam_from_world.values():
        pixels = rng.uniform([0, 0], [camera.width, camera.height], (POINTS_PER_PHOTO, 2))
        ways = np.column_stack([pixels, np.ones(len(pixels))]) @ inverse.T @ pose[:, :3]
        center = camera_center(pose)
        depth = cast_rays(surface, center, ways)["t_hit"]
        points.append((center + depth[:, None] * ways)[depth < REACH_M])
    where = np.concatenate(points)
    photo = PosedPhoto("", camera.K, np.eye(3, 4), camera.width, camera.height)
    near, angle = cluster(where[:, None, :]), photo.widest_angle
    found = []
    for pose in views.cam_from_world.values():
        which = near.find_in_cone(camera_center(pose), pose[2, :3], angle)
        local = where[which] @ pose[:, :3].T + pose[:, 3]
        ahead = (local[:, 2] > 0.1) & (local[:, 2] < REACH_M)
        which, local = which[ahead], local[ahead] @ camera.K.T
        pixels = local[:, :2] / local[:, 2:]
        inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)
        ways = where[which[inside]] - camera_center(pose)
        slack = 0.05 / np.linalg.norm(ways, axis=1)
        open_ones = cast_rays(surface, camera_center(pose), ways)["t_hit"] > 1.0 - slack
        found.append((pixels[inside][open_ones], which[inside][open_ones]))
    return found, where
