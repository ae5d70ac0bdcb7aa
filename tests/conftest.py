"""Fixtures that several groups of tests share."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sfm_app.synthetic.cameras import ArcOptions, arc, make_camera
from sfm_app.synthetic.photo_folder import load_truth, save_truth, write_photo_folder
from sfm_app.synthetic.scenes import build_scene


@pytest.fixture(scope="session")
def rendered(tmp_path_factory):
    """A small rendered photo folder and its truth."""
    place = tmp_path_factory.mktemp("rendered")
    views = arc(make_camera(480, 320), ArcOptions(photos=7, sweep_deg=50.0))
    save_truth(write_photo_folder(place / "photos", build_scene(), views), place)
    return place / "photos", load_truth(place)


@pytest.fixture(scope="session")
def unrelated(tmp_path_factory) -> Path:
    """Two photos of different places: textured, with nothing in common."""
    place = tmp_path_factory.mktemp("unrelated")
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        coarse = Image.fromarray(rng.integers(0, 255, (40, 60, 3), np.uint8)).resize(
            (480, 320), Image.Resampling.BICUBIC
        )
        fine = rng.normal(0, 12, (320, 480, 3))
        Image.fromarray(np.clip(np.asarray(coarse) + fine, 0, 255).astype(np.uint8)).save(place / f"{seed}.jpg")
    return place
