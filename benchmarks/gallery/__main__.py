"""Reconstruct public photo sets and rendered scenes, and draw each model: left its texture, right its bare shape.

    python -m benchmarks.gallery DATA --cache CACHE
    python -m benchmarks.gallery DATA --cache CACHE --only castle-P19 --out docs/pictures

Of a rendered scene, its photo stands left of the model. A run in CACHE that is up to date is not made again.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.common.command_line import new_parser
from benchmarks.surface.photos import placed_photos
from benchmarks.surface.sets import RENDERED, finished_model, surface_set
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import Camera
from sfm_app.synthetic.render import PreparedModel, orbited_pose, render_model, render_shape
from sfm_app.types.surface import Model

Pixels = NDArray[np.uint8]
SUPERSAMPLING = 2
SIZE = (900, 600)
"""Width and height of a picture."""
DIVIDER_PX, QUALITY = 3, 85


@dataclass(frozen=True, slots=True)
class Pose:
    """From where a model is drawn. Chosen by hand, so that most of it is in view."""

    photo: int
    """Number of the placed photo, by name."""
    turn_deg: float = 0.0
    """About the vertical axis through what the photo looks at."""
    zoom: float = 1.0
    """Focal length over that of the photo, where the photo fits into the picture."""
    divide: float = 0.6
    """Share of the width left of the bare shape."""


POSES = {
    "fountain-P11": Pose(5, -12.0, 0.95, 0.46),
    "Herz-Jesus-P8": Pose(3, -12.0, 0.95),
    "castle-P19": Pose(10, 8.0, 0.8),
    "kermit11": Pose(2, -8.0, 1.1, 0.57),
    "statue": Pose(3, divide=0.5),
    "facade": Pose(5, divide=0.5),
}


def draw(model: Model, out: Path, pose: Pose, with_photo: bool) -> Pixels:
    """Return the picture (H, W, 3) of a model.

    Args:
        model: of the run.
        out: the run.
        pose: from where.
        with_photo: whether the photo stands at the left, and the model from its place at the right.
    """
    prepared, images = PreparedModel(model), placed_photos(out)
    image = images[sorted(images)[pose.photo]]
    camera = image.camera
    if camera is None:
        raise ValueError(f"{image.name} has no camera")
    fit = min(SIZE[0] / camera.width, SIZE[1] / camera.height) * pose.zoom * SUPERSAMPLING
    wide, high = SUPERSAMPLING * SIZE[0], SUPERSAMPLING * SIZE[1]
    K = np.diag([fit, fit, 1.0]) @ camera.calibration_matrix()
    K[:2, 2] = wide / 2, high / 2
    place = orbited_pose(np.asarray(image.cam_from_world().matrix()), model.surface, pose.turn_deg)
    seen = Camera(K, wide, high)
    textured, bare = (render(prepared, seen, place).with_background() for render in (render_model, render_shape))
    split = round(wide * pose.divide)
    if with_photo:
        photo = Image.open(out / "photos" / image.name).convert("RGB").resize((wide, high), Image.Resampling.LANCZOS)
        textured, bare = np.asarray(photo), textured
    page = np.concatenate([textured[:, :split], bare[:, split:]], axis=1)
    page[:, split - DIVIDER_PX : split + DIVIDER_PX] = 255
    return np.asarray(cv2.resize(page, SIZE, interpolation=cv2.INTER_AREA), np.uint8)


def main() -> None:
    """Reconstruct and draw."""
    parser = new_parser("gallery", __doc__)
    parser.add_argument("data", type=Path, help="folder with NAME/images")
    parser.add_argument("--cache", type=Path, required=True, help="keeps rendered photos and the runs")
    parser.add_argument("--only", nargs="+", default=list(POSES), choices=list(POSES), metavar="SET")
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.only:
        out = args.cache / "gallery" / name
        model = finished_model(surface_set(name, args.data, args.cache).photos, out, Settings())
        target = args.out / f"{name}.jpg"
        Image.fromarray(draw(model, out, POSES[name], name in RENDERED)).save(target, quality=QUALITY, optimize=True)
        print(target)


if __name__ == "__main__":
    main()
