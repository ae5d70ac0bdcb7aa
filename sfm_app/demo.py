"""The demo: photos of a known scene are rendered, reconstructed and compared with the ground truth."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sfm_app.api import Run, reconstruct
from sfm_app.errors import InputError
from sfm_app.progress import Progress
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages.texture import read_texture
from sfm_app.synthetic.cameras import Camera, arc, camera_center, make_camera
from sfm_app.synthetic.compare import (
    center_error_percent,
    focal_error_percent,
    surface_accuracy,
    surface_coverage,
    surface_error,
)
from sfm_app.synthetic.photo_folder import Truth, load_truth, save_truth, write_photo_folder
from sfm_app.synthetic.pictures import comparison_image
from sfm_app.synthetic.scenes.scene_catalog import build_scene
from sfm_app.types import Model, Scene

SIZE = (960, 640)
"""Width and height of the photos, and of each of the four views in the picture, in pixels."""


@dataclass(frozen=True, slots=True)
class DemoResult:
    """How close the reconstruction of the demo scene came."""

    photos: int
    registered: int
    true_K: list[list[float]]
    found_K: list[list[float]]
    """From the photos alone, before bundle adjustment."""
    refined_K: list[list[float]]
    focal_error_percent: float
    refined_focal_error_percent: float
    center_error_percent: float
    refined_center_error_percent: float
    surface_error_percent: float
    """Median distance of the mesh to the true surface, in percent of the scene's size."""
    surface_accuracy_percent: float
    """Share of the mesh within 0.5 % of the scene's size of the true surface."""
    surface_coverage_percent: float
    """Share of what the photos see that the mesh covers within 1 % of the scene's size."""
    triangles: int
    pages_px: list[list[int]]
    """Width and height of each page of texture."""
    seconds_rendering: float
    seconds_reconstruction: float
    files: list[str]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


def run_demo(out: Path, settings: Settings, progress: Progress) -> DemoResult:
    """Render OUT/photos, reconstruct them into OUT/model, compare, and draw OUT/model.png.

    Args:
        out: output folder.
        settings: of the reconstruction.
        progress: display of progress.

    Raises:
        SfmError: see `sfm_app.errors`.
    """
    start = time.perf_counter()
    progress.stage("rendering photos of a scene with a known camera")
    truth = _render_photos(out, progress)
    rendered = time.perf_counter()
    run = reconstruct(out / "photos", out / "model", settings, progress=progress)
    done = time.perf_counter()
    if run.scene is None or run.calibration is None:
        raise InputError("the demo's reconstruction is incomplete", hint=f"remove {out} and try again")
    model = read_texture(Workspace(run.out))
    draw(model, run.scene, out)
    return evaluate(run, run.scene, model, truth, (rendered - start, done - rendered), out)


def _render_photos(out: Path, progress: Progress) -> Truth:
    """Return the ground truth of the photos in OUT/photos, which are rendered if they are missing."""
    views = arc(make_camera(*SIZE))
    names = set(views.cam_from_world)
    if (out / "truth.json").exists() and {path.name for path in (out / "photos").glob("*.jpg")} == names:
        return load_truth(out)
    truth = write_photo_folder(out / "photos", build_scene(), views, progress=progress)
    save_truth(truth, out)
    return truth


def evaluate(run: Run, scene: Scene, model: Model, truth: Truth, seconds: tuple[float, float], out: Path) -> DemoResult:
    """Measure how close the reconstruction came to the ground truth.

    Args:
        run: the finished run.
        scene: its cameras and poses.
        model: its surface and texture.
        truth: the rendered scene.
        seconds: spent on rendering, and on the reconstruction.
        out: output folder.
    """
    refined = next(iter(scene.cameras.values())).K
    found = run.calibration.K if run.calibration else refined
    centers = {name: camera_center(pose) for name, pose in scene.cam_from_world.items()}
    surface, pages = model.surface, model.texture.pages if model.texture else ()
    found_surface = surface.vertices, surface.faces, centers, truth
    return DemoResult(
        photos=len(truth.cam_from_world),
        registered=len(scene.registered),
        true_K=truth.K.tolist(),
        found_K=found.tolist(),
        refined_K=refined.tolist(),
        focal_error_percent=round(focal_error_percent(found, truth), 3),
        refined_focal_error_percent=round(focal_error_percent(refined, truth), 3),
        center_error_percent=round(center_error_percent(found, truth), 3),
        refined_center_error_percent=round(center_error_percent(refined, truth), 3),
        surface_error_percent=round(100 * surface_error(*found_surface), 3),
        surface_accuracy_percent=round(100 * surface_accuracy(*found_surface), 1),
        surface_coverage_percent=round(100 * surface_coverage(*found_surface), 1),
        triangles=len(surface.faces),
        pages_px=[[page.shape[1], page.shape[0]] for page in pages],
        seconds_rendering=round(seconds[0], 1),
        seconds_reconstruction=round(seconds[1], 1),
        files=[str(path) for path in (*sorted(run.out.glob("model.*")), out / "model.png")],
    )


def draw(model: Model, scene: Scene, out: Path) -> None:
    """Draw OUT/model.png: a photo and the model from the same pose; below, the model from the side and from behind.

    Args:
        model: the finished model.
        scene: cameras and poses of the photos.
        out: output folder, which has the photos and gets the picture.
    """
    names = sorted(scene.cam_from_world)
    name = names[len(names) // 2]
    found = scene.cameras[scene.camera_of[name]]
    camera = Camera(found.K, found.width, found.height)
    photo = np.asarray(Image.open(out / "photos" / name).convert("RGB"))
    Image.fromarray(comparison_image(photo, model, camera, scene.cam_from_world[name])).save(out / "model.png")


def demo_lines(result: DemoResult) -> list[str]:
    """Return the result as lines of text."""
    pages = " and ".join(f"{width} x {height}" for width, height in result.pages_px)
    return [
        f"true camera     {k_text(result.true_K)}",
        f"found           {k_text(result.found_K)}   focal {result.focal_error_percent} % off, "
        f"center {result.center_error_percent} % off, from the photos alone",
        f"refined         {k_text(result.refined_K)}   focal {result.refined_focal_error_percent} % off, "
        f"center {result.refined_center_error_percent} % off, after bundle adjustment",
        f"photos placed   {result.registered} of {result.photos}",
        f"mesh            {result.triangles} triangles; half of it lies within {result.surface_error_percent} % of the "
        f"scene's size of the true surface, {result.surface_accuracy_percent} % within 0.5 %; "
        f"covers {result.surface_coverage_percent} % of what the photos see",
        *([f"texture         {pages} px"] if pages else []),
        f"seconds         {result.seconds_reconstruction} reconstruction, {result.seconds_rendering} rendering",
        *(f"                {path}" for path in result.files),
    ]


def k_text(K: list[list[float]]) -> str:
    """Return a camera matrix in one line."""
    return f"fx {K[0][0]:8.2f}  fy {K[1][1]:8.2f}  cx {K[0][2]:7.2f}  cy {K[1][2]:7.2f}"
