"""Figures that are drawn while the surface is found."""

from types import SimpleNamespace

import pytest

from sfm_app.report.page import early_figures
from sfm_app.report.page.early_figures import SHOWN, EarlyFigures

STAGES = {name: {"digest": f"of {name}"} for name in SHOWN}


@pytest.fixture
def drawings(monkeypatch):
    """The contents of which figures were drawn; those of a run have the digests STAGES."""
    seen = []

    def draw(contents, model):
        seen.append(contents)
        return {"cameras": "a figure"}

    monkeypatch.setattr(early_figures, "read_contents", lambda _: SimpleNamespace(scene=None, stages=STAGES))
    monkeypatch.setattr(early_figures, "page_figures", draw)
    return seen


def make_run(*, report=True, photos=3):
    manifest = {"stages": {"photos": {"counts": {"usable": photos}}}}
    workspace = SimpleNamespace(manifest=SimpleNamespace(read=lambda: manifest))
    return SimpleNamespace(settings=SimpleNamespace(report=report), workspace=workspace)


def test_figures_are_drawn_once_when_the_surface_begins_and_taken_for_the_same_stages(drawings):
    early = EarlyFigures(make_run())

    for stage in ("photos", "scene", "mesh", "texture", "mesh"):
        early.begin(stage)
    found = early.take(SimpleNamespace(stages=STAGES | {"mesh": {"digest": "of the surface"}}))

    assert found is not None and found.figures == {"cameras": "a figure"} and found.model is None
    assert len(drawings) == 1


@pytest.mark.parametrize("changed", SHOWN)
def test_figures_of_stages_that_were_done_again_are_not_taken(drawings, changed):
    early = EarlyFigures(make_run())
    early.begin("mesh")

    assert early.take(SimpleNamespace(stages=STAGES | {changed: {"digest": "another"}})) is None
    assert early.take(SimpleNamespace(stages={name: STAGES[name] for name in SHOWN if name != changed})) is None
    assert early.take(SimpleNamespace(stages=STAGES)) is not None


def test_nothing_is_taken_where_nothing_was_drawn(drawings, monkeypatch):
    without, idle, failed = EarlyFigures(make_run(report=False)), EarlyFigures(make_run()), EarlyFigures(make_run())
    many = EarlyFigures(make_run(photos=101))
    without.begin("mesh")
    many.begin("mesh")
    idle.begin("texture")

    def fail(run):
        raise RuntimeError("no space")

    monkeypatch.setattr(early_figures, "read_contents", fail)
    failed.begin("mesh")

    contents = SimpleNamespace(stages=STAGES)
    assert [early.take(contents) for early in (without, idle, many, failed)] == [None] * 4
    assert not drawings
