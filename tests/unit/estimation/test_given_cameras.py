"""Cameras of the user, and their checks."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.errors import InputError
from sfm_app.estimation.given_cameras import assign_cameras, find_contradictions, fit_to_photos
from sfm_app.photos.probe import split_by_given_camera
from sfm_app.types import Calibration, GivenCameras, MatchedImage, MatchGraph, Photo


def camera(focal=900.0, size=(1000, 800), center=(510.0, 390.0), **values):
    return Calibration(camera_matrix(focal, focal, *center), *size, "given", True, **values)


def photo(key=1, group="a", size=(1000, 800), **values):
    return MatchedImage(key, f"{key}.jpg", group, *size, **values)


def assigned(images, cameras, camera_of=None, *, keep=False):
    graph = MatchGraph({image.id: image for image in images}, {}, {})
    return assign_cameras(graph, GivenCameras(cameras, camera_of or {}, "cameras.txt (COLMAP)", "x"), keep=keep)


def test_a_single_camera_is_that_of_all_photos_of_its_shape():
    images = [photo(1, "a"), photo(2, "half", (500, 400)), photo(3, "square", (800, 800))]
    found = assigned(images, {"1": camera(spread={"fx": 4.0, "k1": 0.01})})
    assert list(found.cameras) == ["a", "half"]
    assert found.cameras["a"].K.tolist() == camera().K.tolist()
    half = found.cameras["half"]
    assert (half.K[0, 0], half.K[0, 2], half.K[1, 2], half.width) == (450.0, 255.0, 195.0, 500)
    assert half.spread == {"fx": 2.0, "k1": 0.01}
    assert "half: from 1000 x 800 to 500 x 400 pixels" in found.notes[0]
    assert "no given camera for the photos square" in found.notes[1] and "cropped" in found.notes[1]


def test_sizes_are_rounded_to_whole_pixels():
    assert fit_to_photos(camera(size=(4000, 3000)), photo(size=(1333, 1000)))[0] is not None
    assert fit_to_photos(camera(size=(4000, 3000)), photo(size=(1333, 997)))[0] is None
    assert "turned" in fit_to_photos(camera(size=(4000, 3000)), photo(size=(3000, 4000)))[1]


def test_the_picture_inside_bars_may_be_what_the_camera_took():
    found, _ = fit_to_photos(camera(size=(1000, 500)), photo(size=(1000, 800), shown=(0, 150, 1000, 500)))
    assert (found.K[0, 2], found.K[1, 2], found.height) == (510.0, 540.0, 800)


def test_a_camera_of_unknown_size_is_taken_as_it_is_where_its_center_lies_inside():
    assert fit_to_photos(camera(size=(0, 0)), photo())[0].width == 1000
    assert "outside" in fit_to_photos(camera(size=(0, 0)), photo(size=(300, 200)))[1]


def test_keep_marks_the_camera():
    assert assigned([photo()], {"1": camera()}, keep=True).cameras["a"].is_kept
    assert not assigned([photo()], {"1": camera()}).cameras["a"].is_kept


def test_names_of_photos_and_groups_come_before_sizes():
    cameras = {"a": camera(800.0), "b": camera(900.0)}
    assert assigned([photo(1, "a"), photo(2, "b")], cameras).cameras["b"].K[0, 0] == 900.0
    assert assigned([photo(1, "x")], cameras, {"1.jpg": "b"}).cameras["x"].K[0, 0] == 900.0
    assert assigned([photo(1, "x")], {"1.jpg": camera(700.0), "b": camera()}).cameras["x"].K[0, 0] == 700.0


def test_sizes_decide_among_several_cameras_where_only_one_fits():
    cameras = {"p": camera(800.0, (640, 480), (320.0, 240.0)), "q": camera(900.0)}
    assert assigned([photo(1, "x", (1000, 800))], cameras).cameras["x"].K[0, 0] == 900.0
    assert assigned([photo(1, "x", (320, 240))], cameras).cameras["x"].K[0, 0] == 400.0
    with pytest.raises(InputError, match="2 cameras of the file fit them, and none is named 'x'"):
        assigned([photo(1, "x")], {"p": camera(800.0), "q": camera(900.0)})


def test_a_file_that_fits_no_photo_is_an_error_and_panoramas_need_none():
    with pytest.raises(InputError, match="fits no photo: no given camera for the photos a"):
        assigned([photo(size=(800, 800))], {"1": camera()})
    assert not assigned([photo(projection="equirectangular")], {"1": camera()}).cameras


def test_photos_of_one_group_with_different_cameras_are_divided():
    photos = [Photo(f"{k}.jpg", 10, 8, "10x8") for k in range(4)]
    given = GivenCameras({"p": camera(), "q": camera()}, {"0.jpg": "p", "1.jpg": "q", "2.jpg": "p"})
    groups = [one.group for one in split_by_given_camera(photos, given)]
    assert groups == ["10x8 by p", "10x8 by q", "10x8 by p", "10x8"]
    assert [one.group for one in split_by_given_camera(photos[::2], given)] == ["10x8", "10x8"]


def found(focal, deviation=5.0, **values):
    spread = {"fx": deviation, "cx": 2.0, "cy": 2.0}
    return replace(camera(focal, spread=spread), method="zero-curves", **values)


@pytest.mark.parametrize(
    ("focal", "deviation", "contradicted"),
    [(905.0, 1.0, False), (925.0, 1.0, True), (925.0, 20.0, False), (1400.0, 20.0, True)],
)
def test_a_focal_is_contradicted_beyond_three_deviations_and_a_percent(focal, deviation, contradicted):
    said = find_contradictions(camera(), found(focal, deviation))
    assert [one.what for one in said] == (["focal length"] if contradicted else [])
    if contradicted:
        assert said[0].text == f"focal length: given 900 px, the photos say {focal:.0f} +- {deviation:.3g} px"


def test_the_deviation_of_the_given_camera_counts():
    assert find_contradictions(camera(spread={"fx": 20.0}), found(925.0, 1.0)) == []


def test_a_center_is_contradicted_where_the_photos_determine_it():
    moved = camera(center=(560.0, 390.0))
    [said] = find_contradictions(moved, found(900.0))
    assert (said.what, said.given_px, said.found_px) == ("optical center, across", 560.0, 510.0)
    assert find_contradictions(moved, found(900.0, held=("center",))) == []


def test_photos_that_do_not_determine_a_camera_contradict_nothing():
    assert find_contradictions(camera(), found(1400.0, identifiable=False)) == []


def wide(focal, radial, **values):
    k1, k2, k3, k4 = radial
    return camera(focal, projection="fisheye", distortion=(k1, k2, 0.0, 0.0, k3, k4), **values)


def test_wide_lenses_are_compared_by_their_curves():
    """An equisolid lens with another focal shows the same as this equidistant one with terms, except far out."""
    theta = np.linspace(0.01, 1.2, 100)
    powers = theta[:, None] ** (2.0 * np.arange(1, 5) + 1.0)
    terms = np.linalg.lstsq(powers, 2.0 * np.sin(theta / 2.0) - theta, rcond=None)[0]
    equisolid, equidistant = wide(400.0, tuple(terms.tolist())), wide(400.0, (0.0, 0.0, 0.0, 0.0))

    assert find_contradictions(equisolid, replace(equisolid, spread={"fx": 1.0})) == []
    [said] = find_contradictions(equisolid, replace(equidistant, spread={"fx": 1.0}))
    assert said.what.endswith("degrees off the axis") and said.given_px < said.found_px
    [said] = find_contradictions(camera(400.0), replace(equidistant, spread={"fx": 1.0}))
    assert said.given_px > 1.1 * said.found_px and "the photos show a fisheye one" in said.text
