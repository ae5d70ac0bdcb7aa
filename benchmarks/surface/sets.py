"""Photo sets for surfaces: rendered ones with their truth, real ones, and parts of them; also the finished model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common.photo_sets import FORMATS, link_or_copy, photo_set
from benchmarks.surface.depth_camera.kinect import KinectTruth, load_kinect
from benchmarks.synthetic.scenes import WALKS, build_scene, scene_views
from sfm_app.api import open_run
from sfm_app.pipeline import DEPTH_MAPS, NAMES, TEXTURE, run_stages
from sfm_app.settings import Settings
from sfm_app.synthetic.photo_folder import PhotoOptions, Truth, load_truth, save_truth, write_photo_folder
from sfm_app.synthetic.shapes import SyntheticScene
from sfm_app.types.surface import Model

RENDERED = ("statue", "facade", "corner")
DETAILED = ("ornament", "railing", "garden")
"""Rendered scenes with fine detail; their photos are noisier, and exposed differently."""
REAL = ("fountain-P11", "Herz-Jesus-P8", "castle-P19", "temple16", "kermit11")
SCANNED: Mapping[str, str] = {"kitchen1000": "every:5"}
"""Real sets with the surface that a depth camera saw, and which photos of them are used."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSet:
    """Photos of one scene."""

    name: str
    photos: Path
    truth: Truth | None
    """Truth of rendered photos; None for real ones."""
    scene: SyntheticScene | None = None
    """What rendered photos show."""
    kinect: KinectTruth | None = None
    """What a depth camera saw beside real photos."""

    @property
    def count(self) -> int:
        """Number of photos."""
        return sum(path.suffix.lower() in FORMATS for path in self.photos.iterdir())


def surface_set(name: str, data: Path | None, cache: Path) -> SurfaceSet:
    """Return one of the program's own scenes, rendered once into the cache, or DATA/NAME/images.

    Args:
        name: a scene, SCENE@SEED for another walk and other noise, or a folder of DATA; "FOLDER every:N" for every Nth
            photo of a set that a depth camera saw, too.
        data: folder of the photo sets.
        cache: folder for rendered and chosen photos.

    Raises:
        ValueError: neither exists.
    """
    scene, _, seed = name.partition("@")
    if scene in WALKS:
        folder = cache / "rendered" / name
        return SurfaceSet(name, folder / "photos", _load_or_render(scene, int(seed or 0), folder), build_scene(scene))
    folder_name, _, change = name.partition(" ")
    if data is not None and folder_name in SCANNED and (data / folder_name / "images").is_dir():
        photos = photo_set(data, folder_name, change or SCANNED[folder_name], cache).folder
        return SurfaceSet(name, photos, None, kinect=load_kinect(data / folder_name))
    if data is None or not (data / name / "images").is_dir():
        raise ValueError(f"'{name}' is neither a rendered scene ({', '.join(WALKS)}) nor a folder of DATA")
    return SurfaceSet(name, data / name / "images", None)


def first_photos(whole: SurfaceSet, count: int, cache: Path) -> SurfaceSet:
    """Make a set of the first photos of another."""
    folder = cache / "parts" / f"{whole.name}-{count}"
    folder.mkdir(parents=True, exist_ok=True)
    photos = sorted(path for path in whole.photos.iterdir() if path.suffix.lower() in FORMATS)
    for photo in photos[:count]:
        link_or_copy(photo, folder)
    return SurfaceSet(f"{whole.name} first {count}", folder, None)


def finished_model(photos: Path, out: Path, settings: Settings) -> Model:
    """Read the textured surface of a finished run, or the one with vertex colors where there is no texture."""
    with open_run(out, settings, None) as run:
        return run_stages([photos], run, last=TEXTURE.name)[TEXTURE]


def dense_stages() -> Sequence[str]:
    """List the stages after the cameras, in order."""
    return NAMES[NAMES.index(DEPTH_MAPS.name) :]


def _load_or_render(name: str, seed: int, folder: Path) -> Truth:
    if not (folder / "truth.json").exists():  # written last
        rough = PhotoOptions(noise=2.5, blur_px=0.6, quality=88, exposure_ev=0.25, seed=seed)
        options = rough if name in DETAILED else PhotoOptions(seed=seed)
        save_truth(write_photo_folder(folder / "photos", build_scene(name), scene_views(name, seed), options), folder)
    return load_truth(folder)
