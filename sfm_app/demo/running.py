"""A demo: its photos are rendered, reconstructed and compared with the truth."""

import time
from pathlib import Path

import numpy as np
from PIL import Image

from sfm_app.api import Run, reconstruct
from sfm_app.demo.result import DemoResult, evaluate
from sfm_app.demo.scenes import DEMO_SCENES
from sfm_app.errors import InputError
from sfm_app.geometry.lenses.camera_models import calibration_from_model
from sfm_app.progress import Progress
from sfm_app.runtime.parallel import worker_count
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages.texture import read_texture
from sfm_app.synthetic.cameras import Camera, Lens, Views
from sfm_app.synthetic.photo_folder import Truth, add_missing_photos, load_truth, save_truth
from sfm_app.synthetic.render import comparison_image
from sfm_app.types import CameraModel, Model, Scene

TRUTH = "truth.json"
"""In OUT: which photos are rendered there, or will be."""


def run_demo(out: Path, scene: str, settings: Settings, progress: Progress) -> tuple[Run, DemoResult]:
    """Render OUT/photos, reconstruct them into OUT/model, compare, and draw OUT/model.png.

    Args:
        out: output folder.
        scene: one of `demo.SCENES`.
        settings: of the reconstruction.
        progress: display of progress.

    Raises:
        SfmError: see `sfm_app.errors`.
    """
    start = time.perf_counter()
    truth = _render_photos(out, scene, settings, progress)
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


def _render_photos(out: Path, scene: str, settings: Settings, progress: Progress) -> Truth:
    """Return the ground truth of the photos in OUT/photos; those that are missing are rendered.

    Raises:
        InputError: the folder has photos of another scene.
    """
    demo = DEMO_SCENES[scene]
    views, photos = demo.views(), out / "photos"
    there = {path.name for path in photos.glob("*.jpg")}
    progress.stage(f"rendering {len(views.cam_from_world)} photos: {scene}")
    known = load_truth(out) if (out / TRUTH).exists() else None
    is_known = known is not None and _is_of(known, views)
    if there - set(views.cam_from_world) or (there and not is_known):
        raise InputError(f"{photos} has other photos", hint="name another folder with -o, or remove this one")
    if known is not None and is_known and there == set(views.cam_from_world):
        return known
    built = demo.build()
    truth = Truth(dict(views.cameras), dict(views.cam_from_world), built.vertices, built.faces)
    out.mkdir(parents=True, exist_ok=True)
    save_truth(truth, out)  # first: it says what the photos are that a killed demo leaves
    return add_missing_photos(photos, built, views, processes=worker_count(settings.workers), progress=progress)


def _is_of(truth: Truth, views: Views) -> bool:
    """Return whether the truth is that of these views."""
    poses = views.cam_from_world
    return truth.cam_from_world.keys() == poses.keys() and all(
        np.allclose(truth.cam_from_world[name], pose)
        and np.allclose(truth.cameras[name].K, views.cameras[name].K)
        and truth.cameras[name].lens == views.cameras[name].lens
        for name, pose in poses.items()
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
    photo = np.asarray(Image.open(out / "photos" / name).convert("RGB"))
    Image.fromarray(comparison_image(photo, model, camera_of(found), scene.cam_from_world[name])).save(
        out / "model.png"
    )


def camera_of(found: CameraModel) -> Camera:
    """Return the camera through which a model looks as it does in the photo; of a fisheye with its lens.

    Args:
        found: after bundle adjustment.
    """
    known = calibration_from_model(found.model, found.params, (found.width, found.height))
    lens = Lens("equidistant", tuple(known.fisheye)) if known.projection == "fisheye" else Lens()
    return Camera(found.K, found.width, found.height, lens)
