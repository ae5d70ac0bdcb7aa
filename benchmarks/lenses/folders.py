"""Rendered folders, one for each scene, projection and field of view."""

from dataclasses import dataclass
from pathlib import Path

from benchmarks.synthetic.scenes import build_scene
from benchmarks.synthetic.walks import WallWalkOptions, wall_walk
from sfm_app.synthetic.cameras import ArcOptions, Camera, Lens, Views, arc, make_wide_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, Truth, load_truth, save_truth, write_photo_folder

SIZE = (960, 640)
PHOTOS = 12
SCENES = ("courtyard", "facade")
FIELDS_DEG = (60.0, 90.0, 120.0, 150.0, 175.0)
"""Along the longer side."""
PROJECTIONS = ("equidistant", "equisolid", "stereographic")
NARROW_DEG = 60.0
"""At this field of view the photos are taken from the usual distance; at wider ones from nearer, so that the scene
fills them."""


@dataclass(frozen=True, slots=True)
class Folder:
    """One rendered folder."""

    scene: str
    projection: str
    field_deg: float

    @property
    def name(self) -> str:
        """Name of its subfolder in the cache."""
        return f"{self.scene}-{self.projection}-{self.field_deg:g}"


def render_folder(folder: Folder, cache: Path) -> tuple[Path, Truth]:
    """Return the photos of a folder and their truth; rendered on first use."""
    photos, truth = cache / "photos" / folder.name, cache / "truth" / folder.name
    if not truth.exists():  # written last
        camera = make_wide_camera(*SIZE, folder.field_deg, Lens(folder.projection))
        save_truth(write_photo_folder(photos, build_scene(folder.scene), _views(folder, camera), PhotoOptions()), truth)
    return photos, load_truth(truth)


def _views(folder: Folder, camera: Camera) -> Views:
    nearer = max(0.5, min(1.0, NARROW_DEG / folder.field_deg))
    if folder.scene == "facade":
        walk = WallWalkOptions(photos=PHOTOS, distance=(5.0 * nearer, 7.0 * nearer))
        return wall_walk(camera, walk)
    return arc(camera, ArcOptions(photos=PHOTOS, distance=(4.6 * nearer, 6.6 * nearer)))
