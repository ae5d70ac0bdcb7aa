"""What a finished run leaves behind for one with other photos."""

from dataclasses import replace

import pytest

from sfm_app.engine.incremental import find_earlier, forget_earlier, set_aside
from sfm_app.engine.stage import Stage, manifest_head, settings_and_versions
from sfm_app.files import digest_files
from sfm_app.runtime.workspace import StageRecord
from sfm_app.settings import Settings

BEFORE, NOW = {"a.jpg": "1", "b.jpg": "2"}, {"a.jpg": "1", "c.jpg": "3"}


def stage(name, *settings, grows=True):
    file = f"{name}.txt"
    return Stage(name, (), settings, (file,), None, None, lambda place: digest_files(place.root, file), grows)


STAGES = (stage("match_graph", "matching"), stage("view_graph", "seed"), stage("scene", "scene"),
          stage("mesh", "mesh", grows=False))  # fmt: skip


def finish(run, *stages, photos=BEFORE, text="made"):
    run.workspace.create()
    for one in stages:
        (run.workspace.root / one.files[0]).write_text(f"{text} {one.name}")
        place = run.workspace.manifest
        record = StageRecord(
            f"{text} {one.name}", 1.0, {}, place.sizes(one.files), made_with=settings_and_versions(one, run),
            digest=one.digest(run.workspace), photos=photos if one is STAGES[0] else {},
        )  # fmt: skip
        place.finish(one.name, record, manifest_head(run))


@pytest.fixture
def moved(run):
    """A finished run that was set aside."""
    finish(run, *STAGES)
    set_aside(STAGES, run)
    return run


def there(run):
    return {path.name for path in (run.workspace.root / ".earlier").glob("*.txt")}


def test_files_of_stages_that_grow_are_moved_and_nothing_is_finished_any_more(moved):
    earlier = find_earlier(STAGES, NOW, "", moved)
    assert earlier.stages == ("match_graph", "view_graph", "scene")
    assert (earlier.known, earlier.new, earlier.gone) == ({"a.jpg"}, {"c.jpg"}, {"b.jpg"})
    assert there(moved) == {"match_graph.txt", "view_graph.txt", "scene.txt"}
    assert not (moved.workspace.root / "scene.txt").exists() and (moved.workspace.root / "mesh.txt").exists()
    assert moved.workspace.manifest.read()["stages"] == {}


def test_other_settings_end_what_can_be_gone_on_from(moved):
    seed = replace(moved, settings=Settings.from_mapping({"seed": 5}))
    assert find_earlier(STAGES, NOW, "", seed).stages == ("match_graph",)
    matching = replace(moved, settings=Settings.from_mapping({"matching": {"max_features": 500}}))
    assert find_earlier(STAGES, NOW, "", matching) is None
    assert not (moved.workspace.root / ".earlier").exists()


def test_other_versions_end_it_too(moved, monkeypatch):
    monkeypatch.setattr("sfm_app.engine.stage.versions", lambda: {"numpy": "1.0"})
    assert find_earlier(STAGES, NOW, "", moved) is None


def test_what_is_asked_to_be_done_again_is_done_afresh(moved):
    assert find_earlier(STAGES, NOW, "scene", moved).stages == ("match_graph", "view_graph")
    assert find_earlier(STAGES, NOW, "mesh", moved).stages == ("match_graph", "view_graph", "scene")
    assert find_earlier(STAGES, NOW, "match_graph", moved) is None


def test_asking_for_the_photos_again_does_everything_afresh(moved):
    assert find_earlier(STAGES, NOW, "photos", moved) is None


@pytest.mark.parametrize(("name", "left"), [("scene", ("match_graph", "view_graph")), ("view_graph", ("match_graph",))])
def test_damaged_files_are_not_gone_on_from(moved, name, left):
    find_earlier(STAGES, NOW, "", moved)
    file = moved.workspace.root / ".earlier" / f"{name}.txt"
    file.write_text(file.read_text()[::-1])  # of the same size
    assert find_earlier(STAGES, NOW, "", moved).stages == left


def test_files_that_were_not_moved_when_the_run_was_killed_are_moved_by_the_next(moved):
    root = moved.workspace.root
    (root / ".earlier" / "match_graph.txt").write_bytes((root / "match_graph.txt").read_bytes())
    (root / "match_graph.txt").write_text("the new one has begun")
    assert find_earlier(STAGES, NOW, "", moved).stages == ("match_graph", "view_graph", "scene")
    assert (root / "match_graph.txt").read_text() == "the new one has begun"


def test_a_finished_run_is_not_touched_by_what_lies_beside_it(run):
    finish(run, *STAGES)
    listed = run.workspace.manifest.read()
    set_aside(STAGES, run)
    run.workspace.manifest.write(listed)  # killed before the run was taken from the manifest, and photos put back
    assert find_earlier(STAGES, BEFORE, "", run) is None
    assert (run.workspace.root / "scene.txt").exists() and run.workspace.manifest.read() == listed


def test_the_earlier_run_that_got_further_is_kept(moved):
    find_earlier(STAGES, NOW, "", moved)
    finish(moved, STAGES[0], photos=NOW, text="later")
    set_aside(STAGES, moved)
    assert find_earlier(STAGES, NOW, "", moved).gone == {"b.jpg"}
    finish(moved, *STAGES, photos=NOW, text="later")
    set_aside(STAGES, moved)
    assert find_earlier(STAGES, NOW, "", moved).gone == frozenset()


def test_it_is_removed_once_everything_that_it_has_is_done(moved):
    find_earlier(STAGES, NOW, "", moved)
    finish(moved, *STAGES[:2], text="later")
    forget_earlier(moved, if_finished=True)
    assert there(moved)
    finish(moved, STAGES[2], text="later")
    forget_earlier(moved, if_finished=True)
    assert not (moved.workspace.root / ".earlier").exists()


def test_resuming_never_mixes_a_grown_run_with_a_fresh_one(moved):
    one = find_earlier(STAGES, NOW, "", moved)
    fewer = find_earlier(STAGES, NOW, "scene", moved)
    assert one.fingerprint != fewer.fingerprint
