"""The plug-ins of docs/plugins.md run as they are printed, and its hooks are those of plugins.py."""

import ast
import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import sfm_app
from sfm_app import plugins
from sfm_app.formats import exporters
from sfm_app.plugins import installed_plugins, load_plugins
from sfm_app.settings import EpipolarSettings, MatchSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair

PAGE = Path(__file__).parents[2] / "docs" / "plugins.md"


def block(language, number=0):
    """Return a fenced block by its language, "" for none."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return [text for kind, text in blocks if kind == language][number]


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
    (tmp_path / "my_features.py").write_text(block("python", 2), encoding="utf-8")
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


def fundamentals(rng, count, focal, size):
    """Return (count, 3, 3) matrices of random poses, all but exact, with the optical center in the middle."""
    inverse = np.linalg.inv(np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]]))
    rotations = (cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0] for _ in range(count))
    essentials = np.array([np.cross(np.eye(3), rng.normal(size=3)).T @ R for R in rotations])
    return inverse.T @ (essentials + rng.normal(0, 1e-4, essentials.shape)) @ inverse


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install the printed calibrator as a package does: with an entry point."""
    (tmp_path / "my_calibrator.py").write_text(block("python", 1), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    package = SimpleNamespace(entry_points=[metadata.EntryPoint("my", "my_calibrator", "sfm_app")])
    monkeypatch.setattr(metadata, "distributions", lambda: [package])
    installed_plugins.cache_clear()
    yield
    installed_plugins.cache_clear()
    sys.modules.pop("my_calibrator", None)


def test_the_printed_calibrator_works(installed):
    rng, size = np.random.default_rng(0), (1000, 750)

    found = sfm_app.calibrate_fundamentals(fundamentals(rng, 12, 1100.0, size), size, method="my-focal")
    of_noise = sfm_app.calibrate_fundamentals(rng.normal(size=(12, 3, 3)), size, method="my-focal")

    assert (found.identifiable, found.method, found.reason) == (True, "my-focal", "")
    np.testing.assert_allclose(np.diag(found.K)[:2], 1100, rtol=0.03)
    assert found.evidence["median_ratio"] < 0.01
    assert not of_noise.identifiable and of_noise.reason


def printed(node):
    """An annotation or a default as the page has it: without quotes, and without names that are nobody's business."""
    if node is None:
        return ""
    if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value:
        return node.value
    text = ast.unparse(node).replace("'", '"')
    return "..." if text.startswith("_") else text


def hooks():
    """Every hook of plugins.py, what it returns, and how that is called."""
    trees = [ast.parse(Path(module.__file__).read_text(encoding="utf-8")) for module in (plugins, exporters)]
    classes = {node.name: node for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)}
    for hook in (node for node in classes["Hooks"].body if isinstance(node, ast.FunctionDef)):
        part = hook.returns.slice.id
        yield f"{hook.name}() -> {printed(hook.returns)}"
        fields = [node for node in classes[part].body if isinstance(node, ast.AnnAssign)]
        values = ((f"{f.target.id}: {printed(f.annotation)}", printed(f.value)) for f in fields)
        yield f"    {part}({', '.join(name + (f' = {value}' if value else '') for name, value in values)})"
        for field in fields:
            for kind in (name.id for name in ast.walk(field.annotation) if isinstance(name, ast.Name)):
                call = [
                    node for node in getattr(classes.get(kind), "body", ()) if getattr(node, "name", "") == "__call__"
                ]
                for function in call:
                    given = function.args.posonlyargs[1:] + function.args.args[1:]
                    arguments = ", ".join(f"{argument.arg}: {printed(argument.annotation)}" for argument in given)
                    yield f"    {kind}: ({arguments}) -> {printed(function.returns)}"


def test_the_hooks_are_printed_as_they_are():
    assert block("").splitlines() == list(hooks())
