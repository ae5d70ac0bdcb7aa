"""A run whose page is made, without a run."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sfm_app.report.server import RunResources
from sfm_app.types import Model, Surface

PAGE = b"<!DOCTYPE html><title>a page</title>"


@pytest.fixture
def resources(tmp_path):
    """A page, a model, 30 points and two photos, the second of which is gone."""
    root = tmp_path / "out"
    (root / "photos").mkdir(parents=True)
    (tmp_path / "secret.txt").write_text("secret", encoding="utf-8")
    (root / "model.glb").write_bytes(b"glTF" * 1000)
    Image.new("RGB", (3000, 1500), (200, 30, 30)).save(root / "photos" / "a b.jpg")
    points = Surface(np.zeros((30, 3)), np.zeros((0, 3), np.int64), np.zeros((30, 3), np.uint8))
    workspace = SimpleNamespace(root=root, photos=root / "photos")
    contents = SimpleNamespace(run=SimpleNamespace(workspace=workspace), stages={"files": {}}, counts=lambda _: {})
    found = RunResources(contents, ["a b.jpg", "gone.jpg"], Model(points))
    found.__dict__["page"] = PAGE
    return found
