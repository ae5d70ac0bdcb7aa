"""The folder that nerfstudio trains from: transforms.json, photos, masks and the sparse points.

Its cameras look along -z with y up. Its points and poses share a frame, which is that of the model; nerfstudio turns
and scales both as it loads them. Every photo has a mask, or none has.
"""

from pathlib import Path
from typing import Any

import numpy as np

from sfm_app.formats.exporters import FinishedScene
from sfm_app.formats.glb import FLIP
from sfm_app.formats.scenes.clouds import cloud_ply
from sfm_app.numerical import json_text
from sfm_app.types.exported import PerspectivePhoto

TRANSFORMS, POINTS = "transforms.json", "sparse_pc.ply"


def write_nerfstudio(scene: FinishedScene, target: Path) -> None:
    """Write transforms.json, the undistorted photos, their masks and the points.

    Args:
        scene: the finished scene.
        target: folder to fill.
    """
    found = scene.perspective()
    found.write_photos(target)
    (target / POINTS).write_bytes(cloud_ply(scene.points()))
    (target / TRANSFORMS).write_text(json_text(transforms(found.photos)), encoding="utf-8", newline="\n")


def transforms(photos: tuple[PerspectivePhoto, ...]) -> dict[str, Any]:
    """Return what transforms.json holds; intrinsics are at its top where all photos share them.

    Args:
        photos: undistorted, at least one.
    """
    lenses = [intrinsics(photo) for photo in photos]
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    frames = [({} if shared else lens) | frame(photo) for lens, photo in zip(lenses, photos, strict=True)]
    return {"camera_model": "OPENCV", **shared, "ply_file_path": POINTS, "frames": frames}


def intrinsics(photo: PerspectivePhoto) -> dict[str, float]:
    """Return the intrinsics of a photo by nerfstudio's names."""
    K = photo.K.tolist()
    pinhole = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2], "w": photo.width, "h": photo.height}
    return pinhole | dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)


def frame(photo: PerspectivePhoto) -> dict[str, Any]:
    """Return the file and the pose of a photo."""
    R, t = photo.cam_from_world[:, :3], photo.cam_from_world[:, 3]
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3], world_from_cam[:3, 3] = R.T @ FLIP, -R.T @ t
    found: dict[str, Any] = {"file_path": f"images/{photo.image}", "transform_matrix": world_from_cam.tolist()}
    return found | ({"mask_path": f"masks/{photo.mask}"} if photo.mask else {})
