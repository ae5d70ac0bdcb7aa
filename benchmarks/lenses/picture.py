"""Draw a photo of a circular fisheye beside the model that such photos give: the picture in the README.

python -m benchmarks.lenses.picture --cache CACHE --out docs/fisheye.jpg
"""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.common.command_line import new_parser
from benchmarks.surface.photos import placed_photos
from sfm_app.api import reconstruct
from sfm_app.camera.models import camera_matrix
from sfm_app.colmap.backend import pycolmap
from sfm_app.products import read_texture
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import ArcOptions, Camera, Lens, arc
from sfm_app.synthetic.compare import surface_errors
from sfm_app.synthetic.photo_folder import PhotoOptions, Truth, load_truth, save_truth, write_photo_folder
from sfm_app.synthetic.render import PreparedModel, comparison_image
from sfm_app.synthetic.scenes import courtyard

SIZE, CENTER, RADIUS_PX = (800, 600), (410.0, 296.0), 300.0
"""Of the photos: size, optical center, and radius of the circle that shows 180 degrees."""
PHOTOS, DISTANCE = 12, (2.4, 3.6)
QUALITY, WIDTH_PX = 88, 1400
"""Of the picture."""


def circular_fisheye() -> Camera:
    """Return an equidistant camera whose circle of 180 degrees is as high as the photo."""
    focal = RADIUS_PX / (0.5 * np.pi)
    return Camera(camera_matrix(focal, focal, *CENTER), *SIZE, Lens("equidistant"))


def render_circles(cache: Path) -> tuple[Path, Truth]:
    """Return photos of the court that are black outside the circle, and their truth; rendered on first use."""
    photos, truth = cache / "photos" / "circle", cache / "truth" / "circle"
    if not truth.exists():  # written last
        views = arc(circular_fisheye(), ArcOptions(photos=PHOTOS, distance=DISTANCE))
        made = write_photo_folder(photos, courtyard(), views, PhotoOptions())
        x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
        outside = np.hypot(x - CENTER[0], y - CENTER[1]) > RADIUS_PX - 2.0
        for path in sorted(photos.glob("*.jpg")):
            pixels = np.array(Image.open(path).convert("RGB"))
            pixels[outside] = 0
            Image.fromarray(pixels).save(path, quality=PhotoOptions().quality)
        save_truth(made, truth)
    return photos, load_truth(truth)


def draw(out: Path, name: str) -> NDArray[np.uint8]:
    """Return the photo, the model through the same lens and from beside, and its bare shape.

    Args:
        out: finished run, whose camera is an OPENCV_FISHEYE.
        name: of the photo.
    """
    model = pycolmap.Reconstruction(out / "sparse")
    image = next(image for image in model.images.values() if image.name == name)
    found = model.cameras[image.camera_id]
    fx, fy, cx, cy, *terms = found.params
    camera = Camera(camera_matrix(fx, fy, cx, cy), found.width, found.height, Lens("equidistant", tuple(terms)))
    pixels = np.asarray(Image.open(out / "photos" / name).convert("RGB"))
    return comparison_image(
        pixels, PreparedModel(read_texture(Workspace(out))), camera, image.cam_from_world().matrix()
    )


def main() -> None:
    """Render, reconstruct and draw."""
    parser = new_parser("lenses.picture", __doc__)
    parser.add_argument("--cache", type=Path, required=True, help="keeps rendered photos and the run")
    parser.add_argument("--out", type=Path, default=Path("docs/fisheye.jpg"))
    args = parser.parse_args()
    photos, truth = render_circles(args.cache)
    out = args.cache / "runs" / "circle"
    reconstruct(photos, out, Settings())
    page = draw(out, sorted(placed_photos(out))[PHOTOS // 2])
    height = round(page.shape[0] * WIDTH_PX / page.shape[1])
    Image.fromarray(cv2.resize(page, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)).save(args.out, quality=QUALITY)
    surface = read_texture(Workspace(out)).surface
    centers = {name: np.asarray(image.projection_center()) for name, image in placed_photos(out).items()}
    to_truth, to_mesh = surface_errors(surface.vertices, surface.faces, centers, truth)
    print(
        f"{args.out}: {len(centers)} of {PHOTOS} photos placed, {100 * np.mean(to_truth <= 0.005):.1f} % of the "
        f"surface within 0.5 % of the scene's size of the truth, {100 * np.mean(to_mesh <= 0.01):.1f} % of what is "
        "seen covered"
    )


if __name__ == "__main__":
    main()
