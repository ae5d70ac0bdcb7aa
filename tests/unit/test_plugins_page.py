"""The plug-in of docs/plugins.md runs as it is printed."""

import re
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np

from sfm_app.plugins import Hooks, load_plugins
from sfm_app.settings import EpipolarSettings, MatchSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair

PAGE = Path(__file__).parents[2] / "docs" / "plugins.md"


def block(language, number=0):
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[number]


def test_the_printed_estimator_works(tmp_path, monkeypatch):
    entry = tomllib.loads(block("toml"))["project"]["entry-points"]["sfm_app"]["my-estimator"]
    (tmp_path / f"{entry}.py").write_text(block("python"), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    module = __import__(entry)
    monkeypatch.delitem(sys.modules, entry)
    pair = make_pair(PairOptions(points=300, outliers=0.2), 1)

    found = load_plugins([module], installed=False).estimator("my-magsac").fit(pair.x1, pair.x2, EpipolarSettings(), 0)

    assert found.inliers[pair.is_inlier].mean() > 0.5
    assert found.inliers[~pair.is_inlier].mean() < 0.1


def test_the_printed_features_work(tmp_path, monkeypatch):
    (tmp_path / "my_features.py").write_text(block("python", 1), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    module = __import__("my_features")
    monkeypatch.delitem(sys.modules, "my_features")
    method, options = load_plugins([module], installed=False).feature_method("my-orb"), MatchSettings(max_features=500)
    blots = np.random.default_rng(0).uniform(0, 255, (30, 40, 3)).astype(np.uint8)
    picture = cv2.resize(blots, (320, 240), interpolation=cv2.INTER_NEAREST)

    first, second = (method.find(np.roll(picture, step, axis=1), options) for step in (0, 8))
    rows = method.match(first, second, options)

    assert 100 <= len(rows) <= len(first) <= 500
    steps = second.keypoints[rows[:, 1]] - first.keypoints[rows[:, 0]]
    np.testing.assert_allclose(np.median(steps, axis=0), (8, 0), atol=0.5)  # ORB rounds on its smaller levels
    white = np.full((60, 80, 3), 255, np.uint8)
    assert len(method.find(white, options)) == 0


def test_every_hook_is_in_the_table():
    printed = set(re.findall(r"^\| `(sfm_\w+)`", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    assert printed == {name for name in vars(Hooks) if name.startswith("sfm_")}
