"""Atomic writes, hashes, and arrays from files."""

import zipfile
from pathlib import PurePath, PureWindowsPath

import numpy as np
import pytest

from sfm_app import files
from sfm_app.files import MOST_BYTES, digest_files, fingerprint, is_below, load_arrays, read_text, replace_atomically


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    target = tmp_path / "x.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError), replace_atomically(target) as path:
        path.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.txt"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_text_of_the_user_is_read(tmp_path, encoding):
    (tmp_path / "x.txt").write_text("größe\n", encoding=encoding)
    assert read_text(tmp_path / "x.txt", 100) == "größe\n"


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ("größe".encode("latin-1"), "no text in UTF-8 or UTF-16"),
        (b"\xff\xfe\x31", "no text in UTF-8 or UTF-16"),
        (bytes(101), r"larger than 0\.0001 MB"),
    ],
)
def test_what_is_no_text_says_why(tmp_path, data, says):
    (tmp_path / "x.txt").write_bytes(data)
    with pytest.raises(ValueError, match=says):
        read_text(tmp_path / "x.txt", 100)


def test_arrays_come_back(tmp_path):
    np.savez_compressed(tmp_path / "x.npz", a=np.arange(5), b=np.array(["x", "yz"]), c=np.zeros(10_000_000, bool))
    found = load_arrays(tmp_path / "x.npz")
    assert sorted(found) == ["a", "b", "c"]
    assert found["a"].tolist() == list(range(5)) and found["b"].tolist() == ["x", "yz"]


def test_objects_are_refused(tmp_path):
    np.savez(tmp_path / "x.npz", a=np.array([{"an": "object"}], object))
    with pytest.raises(ValueError, match="allow_pickle"):
        load_arrays(tmp_path / "x.npz")


@pytest.mark.slow
def test_a_bomb_is_refused_before_it_goes_off(tmp_path):
    chunk = bytes(2**24)
    with (
        zipfile.ZipFile(tmp_path / "x.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
        file.open("a.npy", "w") as member,
    ):
        for _ in range(MOST_BYTES // len(chunk) + 1):
            member.write(chunk)
    with pytest.raises(ValueError, match="inflates to 10"):
        load_arrays(tmp_path / "x.npz")


@pytest.mark.parametrize("change", ["other bytes", "another name", "one more", "a link"])
def test_the_seal_of_a_folder_is_of_its_names_and_bytes(tmp_path, change):
    folder = tmp_path / "in"
    (folder / "deep").mkdir(parents=True)
    (folder / "a.bin").write_bytes(b"1234")
    (folder / "deep" / "b.bin").write_bytes(b"5678")
    before = digest_files(tmp_path, "in")
    assert digest_files(tmp_path, "in") == before
    path = folder / "deep" / "b.bin"
    if change == "other bytes":
        path.write_bytes(b"5679")
    elif change == "another name":
        path.rename(folder / "b.bin")
    elif change == "one more":
        (folder / "c.bin").touch()
    else:
        path.rename(tmp_path / "b.bin")
        path.symlink_to(tmp_path / "b.bin")

    assert digest_files(tmp_path, "in") != before


def test_what_is_gone_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"x\.bin"):
        digest_files(tmp_path, "x.bin")


@pytest.mark.parametrize(
    ("flavor", "inside", "outside"),
    [
        (PurePath, ("a.jpg", "a/b.jpg", "a..b"), ("../a", "a/../b", "/a", "")),
        (PureWindowsPath, ("in\\x.jpg",), ("C:x.jpg", "\\x.jpg", "C:\\x.jpg", "..\\x")),
    ],
)
def test_names_that_stay_below(monkeypatch, flavor, inside, outside):
    monkeypatch.setattr(files, "PurePath", flavor)
    assert all(map(is_below, inside)) and not any(map(is_below, outside))


def test_fingerprints_ignore_order_of_keys_only():
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert fingerprint([1, 2]) != fingerprint([2, 1])
