"""Finished runs with known cameras."""

from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.colmap.surface import write_points
from sfm_app.formats.meshes import COLOR, NORMAL, PLACE
from sfm_app.frame.scale import MetricFrame
from sfm_app.numerical import json_text
from sfm_app.photos.masks import save_mask
from sfm_app.pipeline import MESH, NAMES, SCALE, SCENE
from sfm_app.runtime.workspace import StageRecord, Workspace
from tests.unit.colored_photos import make_model, write_photos


@pytest.fixture
def make_run(tmp_path):
    """Makes what a run until `scene` leaves, or until `mesh` with a dense cloud; returns its model and folder."""

    def make(*kinds, masks=False, until="mesh", points=400):
        place, model = Workspace(tmp_path / "out"), make_model(kinds or ("lens",))
        place.sparse.mkdir(parents=True)
        model.write(place.sparse)
        write_photos(model, place.photos)
        known = {"deviations": {"fx": 0.25}, "determined": ["center"]}
        cameras = {f"c {image.camera_id}": known for image in model.images.values()}
        camera_of = {image.name: f"c {image.camera_id}" for image in model.images.values()}
        known = {"cameras": cameras, "camera_of": camera_of, "unregistered": {"lost.jpg": "no overlap"}}
        place.scene.write_text(json_text(known), encoding="utf-8")
        if masks:
            for image in model.images.values():
                camera = model.cameras[image.camera_id]
                used = np.ones((camera.height, camera.width), bool)
                used[:, : camera.width // 2] = False
                save_mask(place.masks, image.name, used)
        place.surface.mkdir()
        rng = np.random.default_rng(1)
        cloud = np.zeros(points, PLACE + NORMAL + COLOR)
        for key in ("x", "y", "z"):
            cloud[key] = rng.uniform(-3.0, 5.0, points)
        cloud["nx"], cloud["red"], cloud["blue"] = 1.0, 250, rng.integers(0, 256, points)
        write_points([cloud], place.surface / "fused.ply")
        corners, faces = np.eye(3), np.array([[0, 1, 2]])
        np.savez(place.surface / "surface.npz", vertices=corners, faces=faces, colors=np.zeros((3, 3)))
        place.scale.write_text(json_text(MetricFrame().to_dict()), encoding="utf-8")
        for name in NAMES[: NAMES.index(until) + 1]:
            stage = {"scene": SCENE, "scale": SCALE, "mesh": MESH}.get(name)
            place.manifest.finish(name, StageRecord("", 0.0, digest=stage.digest(place) if stage else ""), {})
        return SimpleNamespace(model=model, place=place, out=place.root, cloud=cloud)

    return make
