import json

import pytest

from sfm_app.errors import InputError
from sfm_app.workspace import StageRecord, Workspace, fingerprint


@pytest.fixture
def place(tmp_path):
    workspace = Workspace(tmp_path / "out")
    workspace.create()
    return workspace


def finish(place, name="photos", print_of_inputs="abc", files=("a.txt",)):
    place.finish(name, StageRecord(print_of_inputs, 1.0, {"usable": 2}, place.sizes(files)), {"program": "test"})


def is_current(place, stage, print_of_inputs):
    record = place.record(stage)
    return record is not None and record.fingerprint == print_of_inputs and not place.spoilt(record)


def test_a_finished_stage_is_current_until_its_inputs_change(place):
    (place.root / "a.txt").write_text("1234")
    finish(place)

    assert is_current(place, "photos", "abc")
    assert not is_current(place, "photos", "other")
    assert not is_current(place, "match_graph", "abc")


@pytest.mark.parametrize("damage", ["cut", "removed"])
def test_a_stage_whose_file_changed_is_not_current(place, damage):
    path = place.root / "a.txt"
    path.write_text("1234")
    finish(place)
    if damage == "cut":
        path.write_text("12")
    else:
        path.unlink()

    assert not is_current(place, "photos", "abc")


@pytest.mark.parametrize("text", ["", "[]", "{", '{"stages": {"photos": 3}}', '{"stages": {"photos": {"odd": 1}}}'])
def test_a_broken_manifest_counts_as_none(place, text):
    (place.root / "manifest.json").write_text(text)

    assert place.record("photos") is None


def test_forgotten_stages_leave_the_others(place):
    (place.root / "a.txt").write_text("1234")
    for name in ("photos", "scene"):
        finish(place, name)
    place.forget(("scene", "mesh"))

    assert place.record("scene") is None
    assert place.record("photos") is not None
    assert json.loads((place.root / "manifest.json").read_text())["program"] == "test"


def test_a_file_is_replaced_whole_or_not_at_all(place):
    target = place.root / "x.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError), place.replacing(target) as path:
        path.write_text("half")
        raise RuntimeError

    assert target.read_text() == "old"
    assert [entry.name for entry in place.root.iterdir()] == ["x.txt"]


def test_a_file_in_place_of_the_folder_is_an_input_error(tmp_path):
    (tmp_path / "out").write_text("in the way")

    with pytest.raises(InputError, match="cannot write to"):
        Workspace(tmp_path / "out").create()


def test_fingerprints_ignore_order_of_keys_only():
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert fingerprint([1, 2]) != fingerprint([2, 1])


def test_the_database_may_grow_but_not_vanish(place):
    (place.root / "database.db").write_text("1234")
    finish(place, files=("database.db",))
    (place.root / "database.db").write_text("123456")

    assert is_current(place, "photos", "abc")
    (place.root / "database.db").unlink()
    assert not is_current(place, "photos", "abc")


@pytest.mark.parametrize("inside", ["photos", "photos/2024", "sparse", "dense/images", "other_models/1"])
def test_photos_are_never_where_the_run_writes(tmp_path, inside):
    with pytest.raises(InputError, match="keeps its own files") as caught:
        Workspace(tmp_path).keep_apart(tmp_path / inside)
    assert "-o" in caught.value.hint


def test_photos_beside_what_the_run_writes_are_fine(tmp_path):
    Workspace(tmp_path).keep_apart(tmp_path / "my photos")
    Workspace(tmp_path / "photos" / "out").keep_apart(tmp_path / "photos")
    with pytest.raises(InputError, match="cannot be the photos and the output"):
        Workspace(tmp_path).keep_apart(tmp_path)


def test_what_a_run_wrote_after_its_folder_was_removed_is_not_foreign_to_the_next(tmp_path):
    place = Workspace(tmp_path / "out")
    place.create()
    (place.dense / "images").mkdir(parents=True)  # no lock, as after `rm -r out`
    with pytest.raises(InputError, match="was removed while"):
        place.check_there()

    place.create()


def test_a_folder_that_somebody_put_in_the_place_of_the_output_stays_foreign(tmp_path):
    place = Workspace(tmp_path / "out")
    place.create()
    place.dense.mkdir()
    (place.root / "my notes.txt").touch()
    with pytest.raises(InputError, match="was removed while"):
        place.check_there()

    with pytest.raises(InputError, match="no run has made it"):
        place.create()
