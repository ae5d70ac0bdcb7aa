"""Demos: photos of a known scene are rendered, reconstructed and compared with the truth."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from PIL import Image

from sfm_app.api import Run, reconstruct
from sfm_app.camera.models import projection_of_model, row_of_model
from sfm_app.camera.rows import K1
from sfm_app.errors import InputError
from sfm_app.products import read_texture
from sfm_app.progress import Progress
from sfm_app.report.text import duration_text
from sfm_app.runtime.parallel import worker_count
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import ArcOptions, Camera, Lens, Views, arc, make_camera, make_wide_camera
from sfm_app.synthetic.compare import center_error_percent, focal_error_percent, surface_errors
from sfm_app.synthetic.photo_folder import Truth, load_truth, save_truth, write_photo_folder
from sfm_app.synthetic.render import PreparedModel, comparison_image
from sfm_app.synthetic.scenes import courtyard, statue, statue_views
from sfm_app.synthetic.shapes import SyntheticScene
from sfm_app.types import CameraModel, Model, Scene
from sfm_app.types.scene import camera_center

SIZE = (960, 640)
"""Width and height of the photos of most scenes, in pixels. Chosen by hand."""
TRUTH = "truth.json"
"""File in OUT with the cameras and poses of the photos, rendered or missing."""


class DemoScene(NamedTuple):
    """A scene, and the views of its photos."""

    build: Callable[[], SyntheticScene]
    views: Callable[[], Views]


SCENES: Mapping[str, DemoScene] = MappingProxyType({
    "courtyard": DemoScene(courtyard, lambda: arc(make_camera(*SIZE))),
    "statue": DemoScene(statue, lambda: statue_views(make_camera(*SIZE[::-1], focal_widths=1.35), photos=18)),
    "fisheye": DemoScene(  # 180 degrees from corner to corner, close to the court
        courtyard,
        lambda: arc(make_wide_camera(*SIZE, 150.0, Lens("equidistant")), ArcOptions(distance=(2.4, 3.6))),
    ),
})  # fmt: skip
"""By name. Each takes less than four minutes on two cores."""


@dataclass(frozen=True, slots=True)
class DemoResult:
    """The errors of a demo's reconstruction."""

    photos: int
    registered: int
    true_K: list[list[float]]
    found_K: list[list[float]]
    """Estimate before bundle adjustment."""
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
    """Share of the visible true surface that the mesh covers within 1 % of the scene's size."""
    triangles: int
    pages_px: list[list[int]]
    """Width and height of each page of texture."""
    seconds_rendering: float
    seconds_reconstruction: float
    files: list[str]


def run_demo(out: Path, scene: str, settings: Settings, progress: Progress) -> tuple[Run, DemoResult]:
    """Render OUT/photos, reconstruct them into OUT/model, compare, and draw OUT/model.png."""
    start = time.perf_counter()
    truth = render_photos(out, scene, settings, progress)
    rendered = time.perf_counter()
    progress.finish_stage(rendered - start)
    run = reconstruct(out / "photos", out / "model", settings, progress=progress)
    done = time.perf_counter()
    if run.scene is None or run.calibration is None:
        raise InputError("the demo's reconstruction is incomplete", hint=f"remove {out} and try again")
    progress.stage("comparing with the truth")
    model = read_texture(Workspace(run.out))
    draw(model, run.scene, out)
    result = evaluate(run, run.scene, model, truth, (rendered - start, done - rendered), out)
    progress.finish_stage(time.perf_counter() - done)
    return run, result


def render_photos(
    out: Path, scene: str, settings: Settings, progress: Progress, scenes: Mapping[str, DemoScene] = SCENES
) -> Truth:
    """Return the truth of the photos in OUT/photos, after rendering the missing ones; InputError for other photos."""
    demo = scenes[scene]
    views, photos = demo.views(), out / "photos"
    files = {path.name for path in photos.glob("*.jpg")}
    progress.stage(f"rendering {len(views.cam_from_world)} photos: {scene}")
    known = load_truth(out) if (out / TRUTH).exists() else None
    is_known = known is not None and _is_of(known, views)
    if files - set(views.cam_from_world) or (files and not is_known):
        raise InputError(f"{photos} holds photos of another scene", hint="name another folder with -o, or remove it")
    if known is not None and is_known and files == set(views.cam_from_world):
        return known
    built = demo.build()
    truth = Truth(dict(views.cameras), dict(views.cam_from_world), built.vertices, built.faces)
    out.mkdir(parents=True, exist_ok=True)
    save_truth(truth, out)  # first: it identifies the photos of a killed demo
    return write_photo_folder(photos, built, views, processes=worker_count(settings.workers), progress=progress)


def _is_of(truth: Truth, views: Views) -> bool:
    poses = views.cam_from_world
    return truth.cam_from_world.keys() == poses.keys() and all(
        np.allclose(truth.cam_from_world[name], pose)
        and np.allclose(truth.cameras[name].K, views.cameras[name].K)
        and truth.cameras[name].lens == views.cameras[name].lens
        for name, pose in poses.items()
    )


def draw(model: Model, scene: Scene, out: Path) -> None:
    """Draw OUT/model.png: a photo and the model from the same pose; below, the model from the side and from behind."""
    names = sorted(scene.cam_from_world)
    name = names[len(names) // 2]
    camera = camera_of(scene.cameras[scene.camera_of[name]])
    photo = np.asarray(Image.open(out / "photos" / name).convert("RGB"))
    picture = comparison_image(photo, PreparedModel(model), camera, scene.cam_from_world[name])
    Image.fromarray(picture).save(out / "model.png")


def camera_of(model: CameraModel) -> Camera:
    """Return the camera of the renderer for an estimated camera; of lenses, it has that of a fisheye."""
    k1, k2, _, _, k3, k4, *_ = row_of_model(model.model, model.params)[K1:].tolist()
    lens = Lens("equidistant", (k1, k2, k3, k4)) if projection_of_model(model.model) == "fisheye" else Lens()
    return Camera(model.K, model.width, model.height, lens)


def evaluate(run: Run, scene: Scene, model: Model, truth: Truth, seconds: tuple[float, float], out: Path) -> DemoResult:
    """Return the errors of a reconstruction; `seconds` are of rendering and reconstruction."""
    refined = next(iter(scene.cameras.values())).K
    K = run.calibration.K if run.calibration else refined
    centers = {name: camera_center(pose) for name, pose in scene.cam_from_world.items()}
    surface, pages = model.surface, model.texture.pages if model.texture else ()
    reports = [run.report_path] if run.report_path is not None else []
    to_truth, to_mesh = surface_errors(surface.vertices, surface.faces, centers, truth)
    return DemoResult(
        photos=len(truth.cam_from_world),
        registered=len(scene.registered),
        true_K=truth.K.tolist(),
        found_K=K.tolist(),
        refined_K=refined.tolist(),
        focal_error_percent=round(focal_error_percent(K, truth), 3),
        refined_focal_error_percent=round(focal_error_percent(refined, truth), 3),
        center_error_percent=round(center_error_percent(K, truth), 3),
        refined_center_error_percent=round(center_error_percent(refined, truth), 3),
        surface_error_percent=round(100 * float(np.median(to_truth)), 3),
        surface_accuracy_percent=round(100 * float(np.mean(to_truth <= 0.005)), 1),
        surface_coverage_percent=round(100 * float(np.mean(to_mesh <= 0.01)), 1),
        triangles=len(surface.faces),
        pages_px=[[page.shape[1], page.shape[0]] for page in pages],
        seconds_rendering=round(seconds[0], 1),
        seconds_reconstruction=round(seconds[1], 1),
        files=[str(path) for path in (*reports, *sorted(run.out.glob("model.*")), out / "model.png")],
    )


def demo_lines(result: DemoResult) -> list[str]:
    """Return the result as lines of text."""
    placed = "all" if result.registered == result.photos else f"{result.registered} of"
    seconds = result.seconds_reconstruction, result.seconds_rendering
    files = [path for path in result.files if path.endswith((".html", ".glb"))]
    return [
        f"camera      true   {k_text(result.true_K)}",
        f"            found  {k_text(result.refined_K)}   {result.refined_focal_error_percent:.2g} % off",
        f"mesh        of {placed} {result.photos} photos, {result.triangles:,} triangles: "
        f"{result.surface_accuracy_percent} % within 0.5 % of the scene's size "
        f"of the truth; it covers {result.surface_coverage_percent} % of the visible surface",
        f"took        {duration_text(seconds[0])}, and {duration_text(seconds[1])} to render the photos",
        *(f"{'' if number else 'open':12}{path}" for number, path in enumerate(files)),
    ]


def k_text(K: list[list[float]]) -> str:
    """Return a camera matrix in one line."""
    return f"fx {K[0][0]:7.2f}  fy {K[1][1]:7.2f}  cx {K[0][2]:7.2f}  cy {K[1][2]:7.2f}"
