"""Pairs with a time stamp, with failures, and of a killed run."""

import numpy as np
import pytest

from sfm_app.estimation import fitting
from sfm_app.fundamental.degeneracy import ONLY_A_LOGO
from sfm_app.plugins import load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages import view_graph
from sfm_app.types import MatchedImage, MatchGraph

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
def build(tmp_path):
    with make_executor(2) as executor:
        run = RunContext(Settings(), Workspace(tmp_path), load_plugins(), executor, 2, fingerprint="these")
        yield lambda matches: (view_graph.make(matches, run), run.statistics)


def test_time_stamps_are_taken_out_and_counted(build):
    graph, counts = build(match_graph())
    assert counts["stationary"] == 80
    assert graph.fits[1, 2].inliers[:120].all() and not graph.fits[1, 2].inliers[120:].any()
    assert graph.rejected[1, 3].reason == ONLY_A_LOGO


def test_nothing_is_stationary_in_photos_of_different_size(build):
    _, counts = build(match_graph(widths=(640, 800, 800)))
    assert counts["stationary"] == 0


class Killed(BaseException):
    """What no program catches."""


def test_a_killed_run_goes_on_with_the_pair_that_it_had_come_to(build, tmp_path, monkeypatch):
    matches = match_graph()
    build(matches)
    expected = (tmp_path / "view_graph.npz").read_bytes()
    monkeypatch.setattr(fitting, "PART", 1)
    write, written = fitting.write_part, []

    def dies_at_the_second(path, found):
        if written:
            raise Killed
        written.append(path)
        write(path, found)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(fitting, "write_part", dies_at_the_second)
        build(matches)
    stamp = written[0].stat().st_mtime_ns
    parts = []
    monkeypatch.setattr(fitting, "write_part", lambda path, found: (parts.append(path), write(path, found)))
    monkeypatch.setattr(view_graph.shutil, "rmtree", lambda _: parts.append(written[0].stat().st_mtime_ns))
    build(matches)

    assert len(parts) == 2 and parts[0] != written[0] and parts[1] == stamp
    assert (tmp_path / "view_graph.npz").read_bytes() == expected


def test_parts_come_back_as_they_were(build, tmp_path):
    graph, _ = build(match_graph())
    found = {pair: (fit, 3) for pair, fit in graph.fits.items()} | {
        pair: (no, 0) for pair, no in graph.rejected.items()
    }
    fitting.write_part(tmp_path / "part.npz", found)
    again = fitting.read_part(tmp_path / "part.npz", list(found))
    assert [count for _, count in again.values()] == [3, 0]
    arrays = [fitting.to_view_graph(parts).to_arrays() for parts in (found, again)]
    assert all(np.array_equal(arrays[0][name], arrays[1][name]) for name in arrays[0])


def test_a_pair_on_which_an_estimator_fails_is_rejected_with_a_reason(build, monkeypatch):
    def failing(x1, *_):
        raise np.linalg.LinAlgError("SVD did not converge")

    def failing_where_few(how, points, *rest):
        return (failing if len(points[0]) < 100 else fit)(how, points, *rest)

    fit = fitting.fit_moving
    monkeypatch.setattr(fitting, "fit_moving", failing_where_few)

    graph, counts = build(match_graph())

    assert counts["rejected"] == {"the computation failed": 1} and list(graph.fits) == [(1, 2)]


@pytest.mark.parametrize("error", [IndexError("out of bounds"), ValueError("shapes do not fit")])
def test_a_bug_in_a_fit_ends_the_run(build, monkeypatch, error):
    def failing(*_):
        raise error

    monkeypatch.setattr(fitting, "fit_moving", failing)

    with pytest.raises(type(error), match=str(error)):
        build(match_graph())
