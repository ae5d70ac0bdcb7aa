"""Render photo folders with ground truth; InputError for a folder that cannot be read or written."""

import json
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from sfm_app.errors import InputError
from sfm_app.files import replace_atomically
from sfm_app.formats.meshes import triangles
from sfm_app.progress import Progress, track
from sfm_app.synthetic.cameras import Camera, Lens, Views, check_ranges
from sfm_app.synthetic.render import GAMMA, prepare, render_scene
from sfm_app.synthetic.shapes import SyntheticScene
from sfm_app.types.arrays import ByteArray, FloatArray, IndexArray
from sfm_app.types.scene import camera_center

TRUTH_FILE, SURFACE_FILE = "truth.json", "surface.ply"


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoOptions:
    """Image quality of rendered photos."""

    supersampling: int = 2
    """Rays per pixel in x and in y, 1..8."""
    blur_px: float = 0.5
    """Standard deviation of the Gaussian blur, in pixels, >= 0."""
    noise: float = 1.5
    """Standard deviation of the sensor noise, in gray levels of 255, >= 0."""
    quality: int = 92
    """JPEG quality, 1..95."""
    exposure_ev: float = 0.0
    """Standard deviation of the exposure from photo to photo, in stops, 0..3."""
    seed: int = 0

    def __post_init__(self) -> None:
        check_ranges(
            "synthetic photos",
            supersampling=1 <= self.supersampling <= 8,
            blur_px=0 <= self.blur_px <= 100,
            noise=0 <= self.noise <= 100,
            quality=1 <= self.quality <= 95,
            exposure_ev=0 <= self.exposure_ev <= 3,
            seed=self.seed >= 0,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Ground truth of a rendered photo folder."""

    cameras: Mapping[str, Camera]
    cam_from_world: Mapping[str, FloatArray]
    """By photo name: (3, 4) [R | t]."""
    vertices: FloatArray
    """(V, 3) vertices of the surface, y up."""
    faces: IndexArray
    """(T, 3) vertex indices."""

    @property
    def camera(self) -> Camera:
        """The camera of all photos; ValueError if there are several."""
        first, *others = self.cameras.values()
        if any(_camera_entry(camera) != _camera_entry(first) for camera in others):
            raise ValueError("the photos were taken with several cameras")
        return first

    @property
    def K(self) -> FloatArray:
        """(3, 3) camera matrix of all photos in pixels; ValueError as for `camera`."""
        return self.camera.K

    @property
    def centers(self) -> dict[str, FloatArray]:
        """Camera center (3,) in the world by photo name."""
        return {name: camera_center(pose) for name, pose in self.cam_from_world.items()}


def write_photo_folder(
    folder: Path, scene: SyntheticScene, views: Views, options: PhotoOptions | None = None, processes: int = 1,
    progress: Progress | None = None,
) -> Truth:  # fmt: skip
    """Render the missing photos of a folder, a JPEG without EXIF per view; `save_truth` writes the truth elsewhere."""
    missing = [k for k, name in enumerate(views.cam_from_world) if not (folder / name).exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if missing:
            done = _render(missing, processes, folder, scene, views, options or PhotoOptions())
            for _ in track(progress or Progress(), done, "rendering photos", len(missing)):
                pass
    except OSError as err:
        raise InputError(f"cannot write photos to {folder}: {err}", hint="choose another folder") from err
    return Truth(dict(views.cameras), dict(views.cam_from_world), scene.vertices, scene.faces)


def _render(missing: list[int], processes: int, *work: Any) -> Iterator[None]:
    if processes == 1:
        yield from map(_FolderWork(*work).write_photo, missing)
        return
    # a fork would copy the locks of Open3D's threads, but not the threads; Windows waits for 61 processes
    count = min(processes, len(missing), 61)
    with ProcessPoolExecutor(count, get_context("spawn"), _start_process, work) as pool:
        yield from pool.map(_write_in_process, missing)


class _FolderWork:
    def __init__(self, folder: Path, scene: SyntheticScene, views: Views, options: PhotoOptions) -> None:
        self.folder, self.prepared, self.views, self.options = folder, prepare(scene), views, options

    def write_photo(self, number: int) -> None:
        """Render and write one photo, by its place among the views; the file is complete or missing."""
        name = list(self.views.cam_from_world)[number]
        pose = self.views.row_poses.get(name, self.views.cam_from_world[name])
        image = render_scene(self.prepared, self.views.cameras[name], pose, self.options.supersampling)
        photo = develop(image, self.options, np.random.default_rng([self.options.seed, number, 255]))
        with replace_atomically(self.folder / name) as path:
            Image.fromarray(photo).save(path, format="JPEG", quality=self.options.quality)


_WORK: list[_FolderWork] = []
"""The work of this process, set once at its start."""


def _start_process(*work: Any) -> None:
    _WORK.append(_FolderWork(*work))


def _write_in_process(number: int) -> None:
    _WORK[0].write_photo(number)


def develop(image: FloatArray, options: PhotoOptions, rng: np.random.Generator) -> ByteArray:
    """Return an image (H, W, 3) of linear RGB, about 0..1, exposed and blurred, with gamma and noise, in 8 bits."""
    if options.exposure_ev > 0:
        image = image * 2.0 ** rng.normal(scale=options.exposure_ev)
    if options.blur_px > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), options.blur_px), dtype=np.float64)
    levels = 255.0 * np.clip(image, 0.0, 1.0) ** (1.0 / GAMMA)
    levels += rng.normal(scale=options.noise, size=levels.shape)
    return np.round(np.clip(levels, 0.0, 255.0)).astype(np.uint8)


def save_truth(truth: Truth, folder: Path) -> None:
    """Write truth.json (x ~ K d(R X + t) with lens distortion d) and surface.ply into a folder without photos."""
    images = []
    for name, pose in truth.cam_from_world.items():
        rows = {"R": pose[:, :3].tolist(), "t": pose[:, 3].tolist()}
        images.append({"file": name} | _camera_entry(truth.cameras[name]) | rows)
    text = {
        "convention": "x ~ K d(R X + t); world to camera; x right, y down, z forward; pixel centers at +0.5; "
        "d: the lens, x on the plane whose unit is the focal length",
        "images": images,
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / TRUTH_FILE).write_text(json.dumps(text, indent=1), encoding="utf-8", newline="\n")
        (folder / SURFACE_FILE).write_bytes(_to_ply(truth.vertices, truth.faces))
    except OSError as err:
        raise InputError(f"cannot write the truth to {folder}: {err}", hint="choose another folder") from err


def load_truth(folder: Path) -> Truth:
    """Read the files that `save_truth` wrote."""
    try:
        text: dict[str, Any] = json.loads((folder / TRUTH_FILE).read_text(encoding="utf-8"))
        images = text["images"]
        vertices, faces = _from_ply((folder / SURFACE_FILE).read_bytes())
        return Truth(
            cameras={i["file"]: _camera_from_dict(i) for i in images},
            cam_from_world={i["file"]: np.column_stack([i["R"], i["t"]]) for i in images},
            vertices=vertices,
            faces=faces,
        )
    except (OSError, ValueError, KeyError, IndexError, TypeError) as err:
        raise InputError(f"no truth in {folder}: {err}", hint="it holds truth.json and surface.ply") from err


def _camera_entry(camera: Camera) -> dict[str, Any]:
    return {"width": camera.width, "height": camera.height, "K": camera.K.tolist(), "lens": asdict(camera.lens)}


def _camera_from_dict(image: Mapping[str, Any]) -> Camera:
    K = np.array(image["K"], dtype=np.float64)
    terms = image["lens"]
    p1, p2 = map(float, terms["tangential"])
    lens = Lens(str(terms["projection"]), tuple(map(float, terms["radial"])), (p1, p2))
    return Camera(K, int(image["width"]), int(image["height"]), lens)


def _to_ply(vertices: FloatArray, faces: IndexArray) -> bytes:
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode("ascii") + vertices.astype("<f8").tobytes() + triangles(faces).tobytes()


def _from_ply(data: bytes) -> tuple[FloatArray, IndexArray]:
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].decode("ascii").splitlines()
    counts = [int(line.split()[2]) for line in lines if line.startswith("element")]
    vertices = np.frombuffer(data, "<f8", 3 * counts[0], end).reshape(-1, 3)
    faces = np.frombuffer(data, triangles(np.empty((0, 3), np.int64)).dtype, counts[1], end + vertices.nbytes)
    return vertices.copy(), faces["vertex_indices"].astype(np.int64)
