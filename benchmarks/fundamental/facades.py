"""Pairs of photos of rendered facades, most of whose matches lie in one plane, with raw matches and true geometry."""

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.fundamental.real_pairs import true_fields
from benchmarks.synthetic.houses import house
from sfm_app.synthetic.cameras import Views, look_at, make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder
from sfm_app.synthetic.shapes import SyntheticScene

FloatArray = NDArray[np.float64]

PHOTOS, SIZE = 6, (960, 640)
"""Photos of each facade; a pair for every two of them."""


def facade_views(number: int) -> tuple[SyntheticScene, Views]:
    """Draw a house, and photos taken by hand along the street in front of it."""
    rng = np.random.default_rng([77, number])
    camera = make_camera(*SIZE, float(rng.uniform(0.75, 1.4)))
    width = float(rng.uniform(7, 14))
    bodies = house(width, (False, False), rng)
    eaves = max(body.shape.vertices[:, 1].max() for body in bodies)
    to_light = (float(rng.uniform(-0.6, 0.6)), 0.7, 0.6)
    distance = 0.8 * width * rng.uniform(0.8, 1.2) * camera.K[0, 0] / camera.width
    poses = []
    for x in np.linspace(-1, 1, PHOTOS) * rng.uniform(0.3, 0.6) * distance:
        center = np.array([x, rng.uniform(1.4, 2.6), distance * rng.uniform(0.85, 1.15)])
        height = min(0.45 * eaves, center[1] + 0.35 * distance) * rng.uniform(0.8, 1.1)
        aim = np.array([rng.uniform(-0.15, 0.15) * width + 0.25 * x, height, 0.0])
        poses.append(look_at(center, aim, float(rng.normal(0, 2))))
    return SyntheticScene(f"facade {number}", bodies, to_light=to_light), Views.from_poses(camera, poses)


def cached_facade_pairs(number: int, cache: Path) -> Path:
    """Render a facade and match its photos; the file of raw matches is kept in `cache`."""
    path = cache / f"facade-{number}.npz"
    if not path.exists():
        print(f"rendering facade {number}", file=sys.stderr)
        scene, views = facade_views(number)
        write_photo_folder(cache / path.stem, scene, views, PhotoOptions(seed=number))
        names, arrays = list(views.cam_from_world), dict[str, Any]()
        features = [root_sift(cache / path.stem / name) for name in names]
        for i, first in enumerate(names):
            for j in range(i + 1, PHOTOS):
                second = names[j]
                x1, x2 = mutual_nearest(features[i], features[j])
                ends = [(views.cameras[name].K, views.cam_from_world[name]) for name in (first, second)]
                fields = true_fields(*ends) | {"x1": x1, "x2": x2}
                arrays |= {f"{first}-{second}/{field}": value for field, value in fields.items()}
        np.savez_compressed(path, allow_pickle=False, **arrays)
    return path


def root_sift(photo: Path) -> tuple[FloatArray, NDArray[np.float32]]:
    """Return keypoints (N, 2) in pixels, centers at +0.5, and the square roots of normalized descriptors (N, 128)."""
    image = cv2.cvtColor(cv2.imread(str(photo)), cv2.COLOR_BGR2GRAY)
    keypoints, found = cv2.SIFT.create(nfeatures=6000, contrastThreshold=0.02).detectAndCompute(image, None)
    descriptors = np.sqrt(found / np.maximum(found.sum(axis=1, keepdims=True), 1e-9))
    return np.array([point.pt for point in keypoints]) + 0.5, descriptors


def mutual_nearest(
    first: tuple[FloatArray, NDArray[np.float32]], second: tuple[FloatArray, NDArray[np.float32]]
) -> tuple[FloatArray, FloatArray]:
    """Return the points (M, 2) of keypoints that are each other's nearest, without a ratio test."""
    similarity = first[1] @ second[1].T
    there, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
    mutual = np.flatnonzero(back[there] == np.arange(len(there)))
    return first[0][mutual], second[0][there[mutual]]
