import json

import pytest
from filelock import FileLock

from sfm_app.errors import InputError
from sfm_app.runtime import workspace
from sfm_app.runtime.workspace import LOCK, Manifest, StageRecord, Workspace, model_triangles


def test_photos_beside_what_the_run_writes_are_fine(tmp_path):
    Workspace(tmp_path).check_no_overlap(tmp_path / "my photos")
    Workspace(tmp_path / "photos" / "out").check_no_overlap(tmp_path / "photos")
    with pytest.raises(InputError, match="cannot be both the photos and the output"):
        Workspace(tmp_path).check_no_overlap(tmp_path)


def test_what_a_run_wrote_after_its_folder_was_removed_is_not_foreign_to_the_next(tmp_path):
    place = Workspace(tmp_path / "out")
    place.create()
    (place.dense / "images").mkdir(parents=True)  # no lock, as after `rm -r out`
    with pytest.raises(InputError, match="was removed during"):
        place.check_exists()
    place.create()


def test_a_folder_that_somebody_put_in_the_place_of_the_output_stays_foreign(tmp_path):
    place = Workspace(tmp_path / "out")
    place.create()
    place.dense.mkdir()
    (place.root / "my notes.txt").touch()
    with pytest.raises(InputError, match="was removed during"):
        place.check_exists()

    with pytest.raises(InputError, match="no run has made it"):
        place.create()


def test_a_folder_stays_known_where_the_lock_goes_with_its_file(tmp_path, monkeypatch):
    class LockOfWindows(FileLock):
        def release(self, *arguments, **options):
            held = self.is_locked
            super().release(*arguments, **options)
            if held:
                (tmp_path / "out" / LOCK).unlink()

    monkeypatch.setattr(workspace, "FileLock", LockOfWindows)
    place = Workspace(tmp_path / "out")
    place.create()
    with place.hold_lock():
        place.photos.mkdir()  # a run that fails before a stage is finished leaves no more

    assert (place.root / LOCK).exists()
    place.create()


def test_a_lock_that_somebody_removed_is_not_brought_back(tmp_path):
    place = Workspace(tmp_path / "out")
    place.create()
    with place.hold_lock():
        (place.root / LOCK).unlink()
    assert not (place.root / LOCK).exists()


@pytest.fixture
def manifest(tmp_path):
    return Manifest(tmp_path)


def finish(manifest, name="photos", print_of_inputs="abc", files=("a.txt",)):
    manifest.finish(name, StageRecord(print_of_inputs, 1.0, {"usable": 2}, manifest.sizes(files)), {"program": "test"})


def is_current(manifest, stage, print_of_inputs):
    record = manifest.record(stage)
    return record is not None and record.fingerprint == print_of_inputs and not manifest.changed_files(record)


def test_a_finished_stage_is_current_until_its_inputs_change(manifest):
    (manifest.root / "a.txt").write_text("1234")
    finish(manifest)
    assert is_current(manifest, "photos", "abc")
    assert not is_current(manifest, "photos", "other")
    assert not is_current(manifest, "match_graph", "abc")


@pytest.mark.parametrize("damage", ["cut", "removed"])
def test_a_stage_whose_file_changed_is_not_current(manifest, damage):
    path = manifest.root / "a.txt"
    path.write_text("1234")
    finish(manifest)
    if damage == "cut":
        path.write_text("12")
    else:
        path.unlink()

    assert not is_current(manifest, "photos", "abc")


def test_forgotten_stages_leave_the_others(manifest):
    (manifest.root / "a.txt").write_text("1234")
    for name in ("photos", "intrinsics", "scene"):
        finish(manifest, name)
    manifest.forget(("intrinsics", "scene", "mesh"))
    assert manifest.record("scene") is None and manifest.record("intrinsics") is None
    assert manifest.record("photos") is not None
    assert json.loads((manifest.root / "manifest.json").read_text())["program"] == "test"


def test_the_database_may_grow_but_not_vanish(manifest):
    (manifest.root / "database.db").write_text("1234")
    finish(manifest, files=("database.db",))
    (manifest.root / "database.db").write_text("123456")
    assert is_current(manifest, "photos", "abc")
    (manifest.root / "database.db").unlink()
    assert not is_current(manifest, "photos", "abc")


@pytest.mark.parametrize("version", [None, 1, "2"])
def test_a_run_of_another_version_is_refused_in_one_line(manifest, version):
    finish(manifest)
    manifest.check_format()
    known = json.loads(manifest.path.read_text())
    manifest.path.write_text(json.dumps({**known, "format": version, "program": "sfm-app"}))
    with pytest.raises(InputError, match="made by another version") as err:
        manifest.check_format()
    assert "-o" in err.value.hint and "\n" not in str(err.value)


def test_a_folder_without_a_run_of_ours_has_no_format(manifest):
    manifest.check_format()
    manifest.write({"program": "another", "format": 1, "stages": {"photos": {}}})
    manifest.check_format()


def test_a_model_has_the_triangles_that_texturing_has_left():
    mesh, texture = {"counts": {"triangles": 9}}, {"counts": {"triangles": 7}}
    assert model_triangles({"mesh": mesh, "texture": texture}) == 7
    assert model_triangles({"mesh": mesh, "texture": {"counts": {}}}) == 9  # of an earlier version
    assert model_triangles({"mesh": mesh}) == 9
    assert model_triangles({}) is None
