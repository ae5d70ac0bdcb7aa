import pytest
from filelock import FileLock

from sfm_app.errors import InputError
from sfm_app.runtime import workspace
from sfm_app.runtime.workspace import LOCK, Workspace


def test_a_file_in_place_of_the_folder_is_an_input_error(tmp_path):
    (tmp_path / "out").write_text("in the way")

    with pytest.raises(InputError, match="cannot write to"):
        Workspace(tmp_path / "out").create()


@pytest.mark.parametrize("inside", ["photos", "photos/2024", "sparse", "dense/images", "other_models/1"])
def test_photos_are_never_where_the_run_writes(tmp_path, inside):
    with pytest.raises(InputError, match="keeps its own files") as caught:
        Workspace(tmp_path).check_no_overlap(tmp_path / inside)
    assert "-o" in caught.value.hint


def test_photos_beside_what_the_run_writes_are_fine(tmp_path):
    Workspace(tmp_path).check_no_overlap(tmp_path / "my photos")
    Workspace(tmp_path / "photos" / "out").check_no_overlap(tmp_path / "photos")
    with pytest.raises(InputError, match="cannot be both the photos and the output"):
        Workspace(tmp_path).check_no_overlap(tmp_path)


def test_what_a_run_wrote_after_its_folder_was_removed_is_not_foreign_to_the_next(tmp_path):
    place = Workspace(tmp_path / "out")
    place.create()
    (place.dense / "images").mkdir(parents=True)  # no lock, as after `rm -r out`
    with pytest.raises(InputError, match="was removed while"):
        place.check_exists()

    place.create()


def test_a_folder_that_somebody_put_in_the_place_of_the_output_stays_foreign(tmp_path):
    place = Workspace(tmp_path / "out")
    place.create()
    place.dense.mkdir()
    (place.root / "my notes.txt").touch()
    with pytest.raises(InputError, match="was removed while"):
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
