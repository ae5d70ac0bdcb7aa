"""Links and copies, and files that other programs have open."""

import os
import stat
from types import SimpleNamespace

import pytest

from sfm_app import operating_system
from sfm_app.operating_system import Ability, is_link, lacks, link_or_copy, move, replace_file, share_bytes

NO_LINKS = [None, Ability.LINKS]


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photo.jpg"
    path.write_bytes(b"light")
    return path


@pytest.mark.skipif(os.name == "nt" or lacks(Ability.LINKS), reason="Windows asks for a right")
def test_a_link_leads_to_the_file(photo, tmp_path):
    link_or_copy(tmp_path / "place", "photo.jpg", photo)

    assert is_link(tmp_path / "place") and (tmp_path / "place").resolve() == photo.resolve()


@pytest.mark.parametrize("refused", [True, False])
def test_without_links_the_bytes_are_copied_and_the_photo_is_safe(photo, tmp_path, without, monkeypatch, refused):
    if refused:  # the system knows links, but not here
        monkeypatch.setattr("pathlib.Path.symlink_to", refuse)
    else:
        without(Ability.LINKS)
    link_or_copy(tmp_path / "place", photo, photo)

    assert not is_link(tmp_path / "place") and (tmp_path / "place").read_bytes() == b"light"
    (tmp_path / "place").write_bytes(b"dark")
    assert photo.read_bytes() == b"light"


@pytest.mark.parametrize("taken", [(), (Ability.LINKS,)])
def test_what_is_there_is_not_written_through(photo, tmp_path, without, taken):
    without(*taken)
    (tmp_path / "other.jpg").write_bytes(b"another")
    (tmp_path / "place").symlink_to("other.jpg")

    with pytest.raises(FileExistsError):
        link_or_copy(tmp_path / "place", photo, photo)
    assert (tmp_path / "other.jpg").read_bytes() == b"another"


@pytest.mark.parametrize(("taken", "names"), [((), 1 if lacks(Ability.HARD_LINKS) else 2), ((Ability.HARD_LINKS,), 1)])
def test_bytes_are_shared_where_they_can_be(photo, tmp_path, without, taken, names):
    without(*taken)
    share_bytes(photo, tmp_path / "other")

    assert (tmp_path / "other").read_bytes() == b"light" and photo.stat().st_nlink == names


def test_bytes_are_copied_where_sharing_is_refused(photo, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "link", refuse)
    share_bytes(photo, tmp_path / "other")

    assert (tmp_path / "other").read_bytes() == b"light" and photo.stat().st_nlink == 1


def test_a_junction_is_a_link(photo, monkeypatch):
    monkeypatch.setattr(stat, "IO_REPARSE_TAG_MOUNT_POINT", 0xA0000003, raising=False)
    found = SimpleNamespace(st_mode=stat.S_IFDIR, st_reparse_tag=0xA0000003)

    assert is_link(SimpleNamespace(lstat=lambda: found))
    assert not is_link(photo) and not is_link(photo.parent / "nothing")


@pytest.mark.parametrize("act", [replace_file, move])
def test_a_file_that_somebody_looks_at_is_waited_for(photo, tmp_path, without, monkeypatch, act):
    without(Ability.OPEN_FILES)
    slept = let_others_look(monkeypatch, times=3)
    act(photo, tmp_path / "new")

    assert (tmp_path / "new").read_bytes() == b"light" and not photo.exists()
    assert slept == list(operating_system.WAITS_S[:3])


def test_a_file_that_is_never_free_is_an_error(photo, tmp_path, without, monkeypatch):
    without(Ability.OPEN_FILES)
    slept = let_others_look(monkeypatch, times=100)

    with pytest.raises(PermissionError):
        replace_file(photo, tmp_path / "new")
    assert slept == list(operating_system.WAITS_S) and photo.exists()


def test_elsewhere_a_refusal_is_final(photo, tmp_path, monkeypatch):
    monkeypatch.setattr("sfm_app.operating_system.HERE", frozenset(Ability))
    slept = let_others_look(monkeypatch, times=1)

    with pytest.raises(PermissionError):
        replace_file(photo, tmp_path / "new")
    assert slept == []


def refuse(*_arguments, **_options):
    raise OSError("no links here")


def let_others_look(monkeypatch, times):
    """Refuse so many attempts to move a file, and return the list of the seconds that were waited."""
    slept, refused = [], []
    monkeypatch.setattr(operating_system.time, "sleep", slept.append)
    for name, real in (("replace", os.replace), ("rename", os.rename)):

        def attempt(path, target, real=real):
            if len(refused) < times:
                refused.append(path)
                raise PermissionError("another program looks at it")
            real(path, target)

        monkeypatch.setattr(f"pathlib.Path.{name}", attempt)
    return slept
