"""Panoramas of one size share a camera, and so do those among them whose pixels do not say what they are."""

import pytest

from sfm_app.photos.probe import group_by_camera
from sfm_app.types import Photo


def photos(kinds, size=(800, 400)):
    return [Photo(f"{place}.jpg", *size, f"maker {place}", projection=kind) for place, kind in enumerate(kinds)]


@pytest.mark.parametrize("cameras", ["auto", "single", "each"])
def test_panoramas_always_share_one_camera(cameras):
    given = [*photos(["equirectangular"] * 2), Photo("x.jpg", 600, 400, "a")]

    first, second, other = (photo.group for photo in group_by_camera(given, cameras))

    assert first == second == "800x400 equirectangular" and other != first


@pytest.mark.parametrize(
    ("kinds", "size", "around"),
    [
        (["equirectangular"] * 3 + ["perspective"], (800, 400), 4),
        (["equirectangular"] + ["perspective"] * 3, (800, 400), 1),
        (["equirectangular"] * 2 + ["perspective"] * 2, (800, 400), 2),
        (["perspective"] * 4, (800, 400), 0),
        (["equirectangular"] * 3 + ["perspective"], (800, 402), 3),
    ],
    ids=["most", "few", "half", "none", "nearly twice as wide"],
)
def test_most_photos_of_a_size_decide_about_the_others(kinds, size, around):
    found = [photo.projection for photo in group_by_camera(photos(kinds, size), "auto")]

    assert found.count("equirectangular") == around
