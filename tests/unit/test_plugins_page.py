"""The plug-in of docs/plugins.md runs as it is printed."""

import re
import sys
import tomllib
from pathlib import Path

from sfm_app.plugins import Hooks, load_plugins
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair

PAGE = Path(__file__).parents[2] / "docs" / "plugins.md"


def block(language):
    return re.search(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL).group(1)


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


def test_every_hook_is_in_the_table():
    printed = set(re.findall(r"^\| `(sfm_\w+)`", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    assert printed == {name for name in vars(Hooks) if name.startswith("sfm_")}
