"""Files of the finished model."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from sfm_app.engine.stage import Products
from sfm_app.formats import EXPORTERS
from sfm_app.formats.exporters import JPEG_QUALITY
from sfm_app.frame.scale import MetricFrame
from sfm_app.pipeline import FILES
from sfm_app.plugins import load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages import files


@pytest.fixture
def run(tmp_path):
    return RunContext(Settings(), Workspace(tmp_path), load_plugins(), ThreadPoolExecutor(1), 1)


def test_the_manifest_says_how_large_the_files_are_and_how_good_the_pictures(textured_ball, run):
    paths = files.make(textured_ball, MetricFrame(), run)

    assert paths == FILES.load(Products(run), run)
    assert [path.name for path in paths] == ["model.ply", "model.glb"]
    for path in paths:
        assert path.read_bytes() == EXPORTERS[path.suffix[1:]].write(textured_ball, "model")[path.name]
    assert run.statistics == {
        "bytes": {path.name: path.stat().st_size for path in paths},
        "pages_px": [[64, 64], [96, 32]],
        "jpeg_quality": JPEG_QUALITY,
    }


def test_without_a_texture_it_says_nothing_about_pictures(ball, run):
    files.make(ball, MetricFrame(), run)
    assert list(run.statistics) == ["bytes"]
