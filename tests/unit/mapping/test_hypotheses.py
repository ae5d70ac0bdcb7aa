"""A camera for each photo, as a rival; mappers find what the test says, models and database are real."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.colmap.database import open_database
from sfm_app.colmap.model import MappedCamera
from sfm_app.mapping import passes
from sfm_app.mapping import passes as module
from sfm_app.mapping.attempt import Attempt, NoModel, PairSupport, explained_pairs
from sfm_app.mapping.passes import (
    OPTIONS,
    Mappers,
    camera_per_photo_explains_more,
    is_shared_camera_doubtful,
    reconstruct,
    two_cameras_suffice,
    with_camera_per_photo,
    with_two_cameras,
)
from sfm_app.settings import Settings
from sfm_app.types import ViewGraph

pytestmark = pytest.mark.slow

FOCAL = 1280.0
AUTO = Settings()


def attempt(model, contradicted, matches=100, inliers=100):
    return Attempt("incremental", model, {(1, 2): PairSupport(matches, inliers, contradicted)}, "")


def photos(number):
    return SimpleNamespace(num_reg_images=lambda: number)


def views(number):
    fit = SimpleNamespace(degeneracy="")
    return ViewGraph({(k, k + 1): fit for k in range(1, number)}, {})


@pytest.mark.parametrize(
    ("placed", "number", "contradicted", "settings", "asked"),
    [
        (6, 6, 2, AUTO, True),
        (6, 6, 1, AUTO, False),
        (4, 6, 0, AUTO, True),
        (5, 6, 0, AUTO, False),
        (OPTIONS.min_photos - 1, OPTIONS.min_photos - 1, 2, AUTO, False),
        (101, 101, 2, AUTO, False),
        (6, 6, 2, Settings.from_mapping({"photos": {"cameras": "single"}}), False),
    ],
)
def test_it_is_asked_where_one_camera_does_not_explain_photos_that_nobody_grouped(
    cameras, placed, number, contradicted, settings, asked
):
    guess = cameras(method="guess", identifiable=False)
    assert is_shared_camera_doubtful(attempt(photos(placed), contradicted), guess, views(number), settings) is asked


def test_it_is_asked_of_photos_of_a_plane_whose_pairs_are_all_degenerate(cameras):
    none = ViewGraph({}, {})
    guess = cameras(method="guess", identifiable=False)
    assert is_shared_camera_doubtful(attempt(photos(6), 2), guess, none, AUTO)
    assert not is_shared_camera_doubtful(attempt(photos(OPTIONS.min_photos - 1), 2), guess, none, AUTO)


def test_without_a_model_it_is_not_asked(cameras):
    assert not is_shared_camera_doubtful(None, cameras(), views(6), AUTO)


def test_every_photo_gets_a_guess_of_its_own_that_begins_where_mapping_ended(synthetic, cameras):
    model = synthetic.copy()
    model.cameras[1].params = [1111.0, 512.0, 384.0, 0.01]

    found = with_camera_per_photo(
        attempt(model, 2), cameras(700.0, identifiable=False, method="guess"), synthetic.matches
    )

    images = sorted(synthetic.matches.images.values(), key=lambda image: image.name)
    assert [found.camera_name(image) for image in images] == ["one", *(f"one #{k}" for k in range(2, 7))]
    assert sorted(found.cameras) == sorted(found.camera_of.values())
    assert all(
        camera.focal_px == pytest.approx(1111.0) and not camera.is_estimated for camera in found.cameras.values()
    )


def test_a_camera_that_pairs_determine_is_not_divided(synthetic, cameras):
    assert with_camera_per_photo(attempt(synthetic.copy(), 2), cameras(), synthetic.matches) is None


@pytest.mark.parametrize(
    ("own", "better"),
    [
        (attempt(photos(6), 5, 110), True),
        (attempt(photos(6), 6, 110), False),
        (attempt(photos(6), 5, 100), False),
        (attempt(photos(5), 5, 110), False),
        (attempt(photos(7), 10, 110), True),
        (None, False),
    ],
)
def test_it_is_taken_where_it_explains_more_and_contradictions_go(own, better):
    assert camera_per_photo_explains_more(own, attempt(photos(6), 10)) is better


def each_of(synthetic, cameras, focals):
    """A model whose photos have these focals, and its cameras."""
    model = synthetic.copy()
    each = with_camera_per_photo(attempt(model, 2), cameras(method="guess", identifiable=False), synthetic.matches)
    found = {photo: MappedCamera(camera_matrix(focal, focal, 512, 384)) for photo, focal in enumerate(focals, start=1)}
    return attempt(model, 0), each, found


def test_photos_of_two_focals_get_two_cameras(synthetic, cameras, monkeypatch):
    model, each, found = each_of(synthetic, cameras, [1000.0, 1300.0, 1010.0, 1310.0, 990.0, 1290.0])
    monkeypatch.setattr(passes, "cameras_by_photo", lambda _: found)
    two = with_two_cameras(model, each, synthetic.matches)
    names = {photo: two.camera_name(synthetic.matches.images[photo]) for photo in range(1, 7)}
    assert len(two.cameras) == 2 and names[1] == names[3] == names[5] != names[2] == names[4] == names[6]
    assert [two.cameras[names[photo]].focal_px for photo in (1, 2)] == pytest.approx([1000.0, 1300.0])
    assert all(camera.identifiable and camera.method == "mapping" for camera in two.cameras.values())


def test_a_single_photo_of_another_focal_is_no_second_camera(synthetic, cameras, monkeypatch):
    model, each, found = each_of(synthetic, cameras, [1000.0, 1005.0, 1010.0, 1310.0, 990.0, 1001.0])
    monkeypatch.setattr(passes, "cameras_by_photo", lambda _: found)
    assert with_two_cameras(model, each, synthetic.matches) is None


@pytest.mark.parametrize(
    ("two", "as_good"),
    [
        (attempt(photos(6), 0, 1000, 1000), True),
        (attempt(photos(6), 2, 1000, 1000), True),
        (attempt(photos(6), 3, 1000, 1000), False),
        (attempt(photos(6), 0, 800, 1000), False),
        (attempt(photos(5), 0, 1000, 1000), False),
        (None, False),
    ],
)
def test_two_cameras_are_taken_where_they_explain_as_much(two, as_good):
    assert two_cameras_suffice(two, attempt(photos(6), 0, 1000, 1000)) is as_good


@pytest.fixture
def zoom(monkeypatch, synthetic):
    """Mapping, where one camera for all photos leaves matches that a camera for each explains, or does not."""

    def make(*, right):
        asked = []

        def attempts(group, run):
            names = {group.intrinsics.camera_name(image) for image in group.matches.images.values()}
            asked.append(len(names))
            model = synthetic.copy()
            explained = explained_pairs(model, synthetic.matches, synthetic.views, 1.5)
            if (len(names) > 1) is not right:
                explained = {
                    pair: replace(found, matches=found.matches - 10, contradicted=10)
                    for pair, found in explained.items()
                }
            return [Attempt("incremental", model, explained, f"{len(names)} cameras")]

        mappers = Mappers(map_group=attempts, map_baseline=lambda *_: NoModel("colmap", "no rival"))
        monkeypatch.setattr(module, "with_two_cameras", lambda *_: None)
        monkeypatch.setattr(module, "OPTIONS", replace(module.OPTIONS, max_passes=1))
        return asked, mappers

    return make


def cameras_in(path):
    with open_database(path) as database:
        return len(database.read_all_cameras())


def test_photos_of_a_zoom_are_mapped_with_a_camera_each(synthetic, run, cameras, zoom):
    asked, mappers = zoom(right=True)
    found = reconstruct(synthetic.matches, synthetic.views, cameras(method="guess", identifiable=False), run(), mappers)
    assert asked == [1, 6]
    assert len(found.intrinsics.cameras) == 6 and cameras_in(run().workspace.database) == 6
    assert found.tried[-2:] == ("6 cameras (a camera for each photo)", "no rival (a camera for each photo)")


def test_photos_of_one_camera_keep_it_and_so_does_the_database(synthetic, run, cameras, zoom, monkeypatch):
    monkeypatch.setattr(module, "is_shared_camera_doubtful", lambda *_: True)
    asked, mappers = zoom(right=False)
    guess = cameras(method="guess", identifiable=False)
    found = reconstruct(synthetic.matches, synthetic.views, guess, run(), mappers)
    assert asked == [1, 6]
    assert found.intrinsics is guess and cameras_in(run().workspace.database) == 1
