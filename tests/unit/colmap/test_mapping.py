"""COLMAP's two mappers as we call them."""

from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.colmap import mapping
from sfm_app.colmap.backend import largest_model, pycolmap
from sfm_app.colmap.database import open_database
from sfm_app.colmap.tasks import global_options, remove_runaways
from sfm_app.errors import BackendError

pytestmark = pytest.mark.slow

UNKNOWN = ("SIMPLE_RADIAL", [900.0, 500, 400, 0])
KNOWN = ("SIMPLE_RADIAL", [900.0, 500, 400, -0.1])
TWO_FOCALS = ("OPENCV", [900.0, 800, 500, 400, 0, 0, 0, 0])
NEVER, CANCELLED = SimpleNamespace(is_cancelled=False), SimpleNamespace(is_cancelled=True)


# calibration knows more than the first few photos say, and four terms run wild
@pytest.mark.parametrize(
    ("cameras", "sought"), [([UNKNOWN] * 2, True), ([KNOWN], False), ([TWO_FOCALS], False), ([UNKNOWN, KNOWN], False)]
)
def test_mapping_seeks_the_lens_only_where_nothing_is_known_about_it(tmp_path, monkeypatch, cameras, sought):
    start = pycolmap.Reconstruction()
    for camera_id, (model, params) in enumerate(cameras, start=1):
        camera = pycolmap.Camera(camera_id=camera_id, model=model, width=1000, height=800, params=params)
        start.add_camera_with_trivial_rig(camera)
    seen = []

    def grow(database, photos, found, options, **_):
        seen.append((options.ba_refine_extra_params, options.constant_cameras))
        return {0: start}

    monkeypatch.setattr(pycolmap, "incremental_mapping", grow)
    place = tmp_path / "database.db", tmp_path, start, tmp_path / "scratch"

    for kept in ({2, 3}, ()):
        found = mapping.map_incrementally(*place, mapping.incremental_options(0, kept=kept), lambda: None, NEVER)
        assert found is start

    assert seen == [(sought, {2, 3}), (sought, set())], "kept cameras are constant for COLMAP"


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    """A folder with the database of five photos of COLMAP's making, and the true model."""
    place = tmp_path_factory.mktemp("synthetic")
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 5
    options.num_points3D, options.two_view_geometry_has_relative_pose = 100, True
    options.camera_has_prior_focal_length = True
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.2
    with open_database(place / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(noise, model, database)
    return place, model


def mapped_globally(place, names, token=NEVER, seed=0):
    mapping.copy_database(place / "database.db", place / ".global")
    return mapping.map_globally(place, names, place / ".global", seed, token)


def centers(model):
    return np.array([model.images[key].projection_center() for key in sorted(model.images)])


def spans(points):
    """Distances between all points, as shares of the largest: what scale and frame leave alone."""
    found = np.linalg.norm(points[:, None] - points[None], axis=2)
    return found / found.max()


def test_all_photos_at_once_give_the_true_model_the_same_bytes_twice(synthetic, tmp_path):
    place, true = synthetic
    names = [image.name for image in true.images.values()]
    before = (place / "database.db").read_bytes()

    written = []
    for number in range(2):
        model = mapped_globally(place, names)
        target = tmp_path / str(number)
        target.mkdir()
        model.write(target)
        written.append({path.name: path.read_bytes() for path in target.iterdir()})

    assert model.num_reg_images() == 5 and model.num_points3D() > 90
    assert 1e-5 < np.abs(spans(centers(model)) - spans(centers(true))).max() < 0.01
    assert written[0] == written[1] and "images.bin" in written[0]
    assert [path.name for path in place.iterdir()] == ["database.db"]
    assert (place / "database.db").read_bytes() == before


@pytest.mark.parametrize(("factor", "photos"), [(0.11, 5), (9.0, 5), (11.0, 0), (0.09, 0)])
def test_photos_whose_focal_runs_away_are_removed(synthetic, factor, photos):
    before, model = (pycolmap.Reconstruction(synthetic[1]) for _ in range(2))
    for camera in model.cameras.values():
        camera.params = [factor * camera.params[0], *camera.params[1:]]
    remove_runaways(model, before.cameras)
    assert model.num_reg_images() == photos


def test_only_the_photos_asked_for_are_placed_and_of_none_comes_nothing(synthetic):
    place, true = synthetic
    names = sorted(image.name for image in true.images.values())[:3]
    model = mapped_globally(place, names)
    assert sorted(image.name for image in model.images.values() if image.has_pose) == names
    assert mapped_globally(place, ["no such photo"]) is None


def test_a_cancelled_token_stops_the_mapper(synthetic):
    place, true = synthetic
    assert mapped_globally(place, [image.name for image in true.images.values()], CANCELLED) is None
    assert [path.name for path in place.iterdir()] == ["database.db"]


def test_what_colmap_raises_in_its_process_is_raised_here(tmp_path):
    (tmp_path / "database.db").write_bytes(b"no database at all")
    with pytest.raises(BackendError, match=r"all photos at once: .*No registered database factory"):
        mapped_globally(tmp_path, ["any"])
    assert [path.name for path in tmp_path.iterdir()] == ["database.db"]


def test_options_are_ours_for_both_mappers():
    incremental, at_once = mapping.incremental_options(7), global_options(7, ["a", "b"])
    assert (incremental.num_threads, incremental.mapper.num_threads, incremental.multiple_models) == (1, 1, False)
    assert (at_once.num_threads, at_once.mapper.num_threads, list(at_once.image_names)) == (1, 1, ["a", "b"])
    assert not at_once.decompose_relative_pose  # ours are better than what COLMAP makes of F
    parts = [incremental, incremental.mapper, incremental.triangulation, at_once, at_once.mapper]
    parts += [at_once.mapper.rotation_averaging, at_once.mapper.global_positioning, at_once.mapper.retriangulation]
    assert {part.random_seed for part in parts} == {7}


def test_of_several_models_the_one_with_most_photos_counts():
    models = {key: SimpleNamespace(num_reg_images=lambda count=count: count) for key, count in ((0, 2), (1, 5), (2, 3))}
    assert largest_model(models) is models[1] and largest_model({}) is None
