"""Compile the kernels of a run for later ones on this machine: reconstruct small photos of the corner of a room.

python -m sfm_app.warm_up FOLDER
"""

import os
import shutil
import sys
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from sfm_app.api import reconstruct
from sfm_app.jit import PARENT, WARM
from sfm_app.operating_system import end_own_group, watch_parent, yield_to_others
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import look_at
from sfm_app.types.arrays import ByteArray

WIDTH, HEIGHT, FOCAL = 480, 360, 520.0
"""Size and focal length of the photos in pixels: small, and mapped with certainty. Chosen by hand."""
SIDE = 640
"""Side of the pictures on the walls, in pixels."""
QUICK = {"report": False, "matching": {"enlarge_below": 0, "max_features": 2000}, "depth": {"max_image_size_px": 240}}
"""Settings that save time and need the same kernels."""


def write_photos(folder: Path) -> None:
    """Write photos of a floor and two walls of 2 units, each with a pattern of noise."""
    rng = np.random.default_rng(0)
    corners = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
    walls = [(np.roll(corners, turn, axis=1), _noise(rng)) for turn in range(3)]
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    sides = np.array([[0, 0], [SIDE, 0], [SIDE, SIDE], [0, SIDE]], np.float32)
    folder.mkdir(parents=True)
    for number, angle in enumerate(np.linspace(0.35, 1.2, 6)):
        center = np.array([4.0 * np.sin(angle), 1.6 + 0.2 * (number % 2), 4.0 * np.cos(angle)])
        P, photo = K @ look_at(center, np.full(3, 0.7)), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for wall, picture in walls:
            pixels = np.column_stack([wall, np.ones(4)]) @ P.T
            H = cv2.getPerspectiveTransform(sides, np.asarray(pixels[:, :2] / pixels[:, 2:], np.float32))
            cv2.warpPerspective(
                picture, H, (WIDTH, HEIGHT), dst=photo, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_TRANSPARENT
            )
        cv2.imwrite(str(folder / f"{number}.png"), photo)


def _noise(rng: np.random.Generator) -> ByteArray:
    """Return a picture (SIDE, SIDE, 3) with details of many sizes."""
    layers = [
        cv2.resize(rng.normal(size=(n, n, 3)), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC) for n in (10, 40, 160)
    ]
    return np.asarray(np.clip(128 + 40 * sum(layers), 0, 255), np.uint8)


def _end(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    end_own_group()


def main() -> None:
    """Compile, and touch `WARM` even after a failure, which the next run would repeat."""
    folder = Path(sys.argv[1])
    if PARENT in os.environ:
        watch_parent(int(os.environ[PARENT]), partial(_end, folder))
        yield_to_others(5)  # the run needs the cores more
    os.environ[PARENT] = str(os.getpid())
    try:
        write_photos(folder / "photos")
        reconstruct(folder / "photos", folder / "model", Settings.from_mapping(QUICK))
    finally:
        WARM.parent.mkdir(parents=True, exist_ok=True)
        WARM.touch()


if __name__ == "__main__":
    main()
