from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.plugins import load_plugins
from sfm_app.ransac.stationary import ONLY_A_LOGO
from sfm_app.settings import Settings
from sfm_app.stages import view_graph
from sfm_app.types import MatchedImage, MatchGraph
from sfm_app.workspace import Workspace

rng = np.random.default_rng(7)
STAMP = rng.uniform([480, 440], [620, 465], (40, 2))


def match_graph(widths=(640, 640, 640)):
    """Photos 1 and 2 show one scene, 3 another; all bear a time stamp."""
    X = rng.uniform([-2, -1.5, 5], [2, 1.5, 8], (120, 3))
    scene = [(X - [0.8 * k, 0, 0.3 * k])[:, :2] / (X[:, 2:] - 0.3 * k) * 800 + [320, 240] for k in range(2)]
    scene.append(rng.uniform([0, 0], [640, 480], (120, 2)))
    keypoints = {k + 1: np.vstack([x, STAMP]) + rng.normal(scale=0.2, size=(160, 2)) for k, x in enumerate(scene)}
    images = {k: MatchedImage(k, f"{k}.jpg", "one", width, 480) for k, width in enumerate(widths, start=1)}
    rows = np.tile(np.arange(160, dtype=np.uint32)[:, None], 2)
    return MatchGraph(images, keypoints, {(1, 2): rows, (1, 3): rows[110:]})


@pytest.fixture
def build(tmp_path, monkeypatch):
    monkeypatch.setattr(view_graph, "write_epipolar_fits", lambda *_: None)
    counts = {}
    run = SimpleNamespace(
        settings=Settings(),
        seed=0,
        plugins=load_plugins(),
        workspace=Workspace(tmp_path),
        map=lambda function, items, _: [function(item) for item in items],
        record=lambda **found: counts.update(found),
    )
    return lambda matches: (view_graph.build_view_graph(matches, run), counts)


def test_time_stamps_are_taken_out_and_counted(build):
    graph, counts = build(match_graph())

    assert counts["stationary"] == 80
    assert graph.fits[1, 2].inliers[:120].all() and not graph.fits[1, 2].inliers[120:].any()
    assert graph.rejected[1, 3].reason == ONLY_A_LOGO


def test_nothing_is_stationary_in_photos_of_different_size(build):
    _, counts = build(match_graph(widths=(640, 800, 800)))

    assert counts["stationary"] == 0
