"""A folder with photos and a finished run, as the pages assume it."""

import shutil

import pytest

import sfm_app


@pytest.fixture(scope="session")
def finished(rendered, tmp_path_factory):
    """Make a folder with photos/ and a finished run out/."""
    place = tmp_path_factory.mktemp("pages")
    shutil.copytree(rendered[0], place / "photos")
    sfm_app.reconstruct(place / "photos", place / "out")
    return place


@pytest.fixture
def beside_a_run(finished, tmp_path, monkeypatch):
    """Work in a copy of that folder, where a block may write."""
    place = tmp_path / "here"
    shutil.copytree(finished, place, symlinks=True)
    monkeypatch.chdir(place)
    return place
