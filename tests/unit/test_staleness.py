"""What a stage depends on, and why it is done again."""

import os
from types import SimpleNamespace

import pytest

from sfm_app.context import RunContext
from sfm_app.errors import InputError
from sfm_app.manifest import StageRecord
from sfm_app.parallel import make_executor
from sfm_app.settings import Settings
from sfm_app.staleness import made_with, manifest_head, source_of, stage_print, value_of, why_again
from sfm_app.types import Photo, PhotoSet
from sfm_app.workspace import Workspace

SETTINGS = ("matching", "photos.cameras", "seed")


@pytest.fixture
def run(tmp_path):
    with make_executor(1) as executor:
        yield RunContext(Settings(), Workspace(tmp_path / "out"), SimpleNamespace(), executor, 1)


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "photos"
    place.mkdir()
    for name in ("a.jpg", "b.jpg", "notes.txt"):
        (place / name).write_text(name)
    return place


def set_to(run, **values):
    run.settings = Settings.from_mapping(values)


def finished(run):
    """A stage that was finished with what is in force."""
    run.workspace.create()
    (run.workspace.root / "x.txt").write_text("12")
    made_from = stage_print("match_graph", SETTINGS, ["abc"], run)
    used = made_with(SETTINGS, run)
    record = StageRecord(made_from, 1.0, {}, run.workspace.manifest.sizes(("x.txt",)), made_with=used)
    run.workspace.manifest.finish("match_graph", record, manifest_head(run))


def why(run, inputs="abc"):
    return why_again("match_graph", SETTINGS, stage_print("match_graph", SETTINGS, [inputs], run), run)


def test_a_stage_that_was_never_done_needs_no_reason(run):
    assert why(run) == ""


def test_settings_of_other_stages_change_nothing(run):
    finished(run)
    set_to(run, mesh={"faces": 1000}, photos={"keep_low_quality": True}, workers=2)

    assert why(run) is None


def test_a_setting_that_changed_is_named_with_both_values(run):
    finished(run)
    set_to(run, matching={"max_features": 500})
    assert why(run) == "matching.max_features 8192 -> 500"
    set_to(run, photos={"cameras": "single"}, seed=3)
    assert why(run) == 'photos.cameras "auto" -> "single", seed 0 -> 3'


def test_no_more_than_three_are_named(run):
    finished(run)
    set_to(run, quality="high", photos={"cameras": "each"}, seed=1, matching={"max_ratio": 0.7})

    assert why(run).count("->") == 3 and why(run).endswith("and 2 more")


def test_photos_files_and_versions(run, monkeypatch):
    finished(run)
    assert why(run, "other photos") == "the photos have changed"
    monkeypatch.setattr("sfm_app.staleness.versions", lambda: {"numpy": "1.0"})
    assert "-> " in why(run)
    (run.workspace.root / "x.txt").unlink()
    assert why(run) == "x.txt is gone or was changed"


def photos(folder, *names, group=""):
    return PhotoSet(folder, tuple(Photo(name, 60, 40, group) for name in names))


def test_only_photos_that_are_used_matter_to_later_stages(run, folder):
    used = photos(folder, "a.jpg", "b.jpg")
    before = source_of(folder, run)
    (folder / "notes.txt").write_text("something else")
    after = source_of(folder, run)

    assert after.print != before.print and after.content(used) == before.content(used)
    assert after.content(photos(folder, "a.jpg", "b.jpg", group="other")) == before.content(used)
    assert after.content(photos(folder, "a.jpg")) != before.content(used)
    (folder / "b.jpg").write_text("another photo")
    assert source_of(folder, run).content(used) != before.content(used)


@pytest.mark.parametrize(("change", "says"), [("unlink", "is gone since"), ("touch", "has changed since")])
def test_photos_that_change_under_a_run_are_seen(run, folder, change, says):
    source, used = source_of(folder, run), photos(folder, "a.jpg", "b.jpg")
    (folder / "notes.txt").write_text("who cares")
    source.check(used)
    if change == "unlink":
        (folder / "a.jpg").unlink()
    else:
        os.utime(folder / "a.jpg", ns=(1, 1))

    with pytest.raises(InputError, match=says):
        source.check(used)


def test_values_are_found_by_dotted_names():
    assert value_of({"a": {"b": 3}}, "a.b") == 3
    assert value_of({"a": 1}, "a.b") is None
