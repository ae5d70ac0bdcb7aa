"""Photos whose colors are directions in the world, and models of them with points all round."""

import cv2
import numpy as np

from sfm_app.colmap.backend import pycolmap

SIZE = 240, 160
CAMERAS = {
    "lens": ("OPENCV", [250.0, 245.0, 131.0, 73.0, -0.08, 0.01, 1e-3, -5e-4]),
    "other": ("SIMPLE_RADIAL", [210.0, 118.0, 84.0, 0.03]),
    "pinhole": ("PINHOLE", [200.0, 205.0, 140.0, 70.0]),
    "fisheye": ("OPENCV_FISHEYE", [88.0, 88.5, 121.0, 79.0, 0.02, -0.003, 0.0, 0.0]),
    "wide fisheye": ("OPENCV_FISHEYE", [87.5, 88.0, 120.5, 79.0, 0.02, -0.003, 0.0, 0.0]),
    "wide prism": ("THIN_PRISM_FISHEYE", [87.5, 88.0, 120.5, 79.0, 0.02, -0.003, 2e-3, 1e-3, 0, 0, 1e-3, 0]),
    "plain": ("OPENCV", [210.0, 207.5, 120.5, 79.0, 0.05, -0.01, 0.0, 0.0]),
    "strong barrel": ("OPENCV", [130.0, 130.0, 120.0, 80.0, -0.2, 0.025, 0.0, 0.0]),
    "prism": ("THIN_PRISM_FISHEYE", [300.0, 300.0, 121.0, 79.0, 0.02, -0.003, 2e-3, 1e-3, 0, 0, 1e-3, 0]),
    "panorama": ("EQUIRECTANGULAR", [240.0, 120.0]),
}
"""Model and parameters; most optical centers are off the middle."""
NAMES_OF_PHOTOS = ("sub/ä b.c.jpg", "sub_a-b_c.png", "SUB/Ä B_c.jpg")
"""Three photos that trainers would take for one, or could not open."""


def colors_of(rays):
    """Colors (..., 3) of rays of any length: each channel is an axis."""
    return np.round(127.5 + 120.0 * rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.uint8)


def make_model(kinds, photos=NAMES_OF_PHOTOS):
    """A model of three photos with these cameras in turn, and points that each sees exactly where they project."""
    rng, model, names = np.random.default_rng(0), pycolmap.Reconstruction(), {}
    for number, kind in enumerate(dict.fromkeys(kinds), start=1):
        name, params = CAMERAS[kind]
        width, height = (240, 120) if kind == "panorama" else SIZE
        camera = pycolmap.Camera(camera_id=number, model=name, width=width, height=height, params=params)
        model.add_camera_with_trivial_rig(camera)
        names[kind] = number
    X = rng.normal(size=(1500, 3))
    X *= rng.uniform(4.0, 8.0, 1500)[:, None] / np.linalg.norm(X, axis=1, keepdims=True)
    tracks = [pycolmap.Track() for _ in X]
    for index, photo in enumerate(photos, start=1):
        camera = model.cameras[names[kinds[(index - 1) % len(kinds)]]]
        R = cv2.Rodrigues(np.array([0.1, 0.15, 0.05]) * index)[0]
        t = -R @ np.array([0.4 * index, 0.1, 0.0])
        at = X @ R.T + t
        x = np.array(camera.img_from_cam(at))
        seen = np.isfinite(x).all(axis=1) & (x > 0).all(axis=1) & (x < [camera.width, camera.height]).all(axis=1)
        if not camera.is_spherical():
            seen &= at[:, 2] > 0.1 * np.linalg.norm(at, axis=1)
        for row, point in enumerate(np.flatnonzero(seen)):
            tracks[point].add_element(index, row)
        image = pycolmap.Image(name=photo, keypoints=x[seen], camera_id=camera.camera_id, image_id=index)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(R), t))
    for point, track in zip(X, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(point, track, colors_of(point))
    return model


def write_photos(model, folder):
    """Write photos whose colors are the directions of their pixels in the world."""
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        grid = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = np.array(camera.cam_ray_from_img(np.stack(grid, -1).reshape(-1, 2)))
        colors = colors_of(np.nan_to_num(rays, nan=1.0) @ image.cam_from_world().matrix()[:, :3])
        target = folder / image.name
        target.parent.mkdir(parents=True, exist_ok=True)
        picture = colors.reshape(camera.height, camera.width, 3)[..., ::-1]
        quality = [cv2.IMWRITE_JPEG_QUALITY, 100]
        target.write_bytes(cv2.imencode(target.suffix, picture, quality)[1].tobytes())
