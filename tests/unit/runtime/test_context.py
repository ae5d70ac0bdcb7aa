from pathlib import Path

from sfm_app.runtime.context import Earlier, split_names
from sfm_app.runtime.workspace import Workspace


def test_a_replaced_photo_is_gone_and_new_and_a_renamed_one_is_another():
    before = {"a": "1", "b": "2", "c": "3", "d": "4"}
    known, new, gone = split_names(before, {"a": "1", "b": "other", "e": "3", "d": "4"})
    assert known == {"a", "d"} and new == {"b", "e"} and gone == {"b", "c"}


def test_people_read_how_many_photos_are_known_new_and_left():
    def text(known, new, gone):
        return Earlier(Workspace(Path()), (), "", frozenset(known), frozenset(new), frozenset(gone)).text

    assert text("abc", "de", "") == "3 photos are known, 2 are new"
    assert text("ab", "c", "c") == "2 photos are known, 1 are new"
    assert text("ab", "", "cd") == "2 photos are known, 0 are new, 2 are gone"


def test_photos_whose_features_are_others_count_as_replaced():
    earlier = Earlier(Workspace(Path()), (), "", frozenset("abc"), frozenset("d"), frozenset())
    other = earlier.with_replaced({"b", "d"})
    assert (other.known, other.new, other.gone) == (frozenset("ac"), frozenset("bd"), frozenset("b"))
