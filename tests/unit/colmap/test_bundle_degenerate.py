"""The last adjustment on models that have gone astray: it goes on, and says what it could not do."""

import numpy as np
import pytest

from sfm_app.colmap import bundle
from sfm_app.colmap import bundle as bundle_rounds
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.bundle import adjust, adjust_or_keep
from sfm_app.colmap.database import open_database
from sfm_app.errors import BackendError, NumericalError

pytestmark = pytest.mark.slow


def away(model, share, place):
    """Put some points elsewhere."""
    keys = sorted(model.points3D)
    for key in keys[: max(1, int(share * len(keys)))]:
        model.points3D[key].xyz = place(model.points3D[key].xyz)
    return model


ASTRAY = {
    "a point at infinity": lambda model: away(model, 0, lambda xyz: 1e14 * xyz),
    "a point that is nowhere": lambda model: away(model, 0, lambda _: np.array([np.inf, np.nan, 0.0])),
    "a fifth of the points at infinity": lambda model: away(model, 0.2, lambda xyz: 1e13 * xyz),
    "a point in a camera": lambda model: away(model, 0, lambda _: model.images[1].projection_center()),
    "a fifth of the points in one place": lambda model: away(model, 0.2, lambda _: np.zeros(3)),
}


@pytest.mark.parametrize("case", ASTRAY)
def test_points_that_have_gone_astray_do_not_end_it_and_the_camera_is_found(mapped, case):
    model, database = mapped()

    found = adjust(ASTRAY[case](model), database)

    camera, deviations = found.model.cameras[1], found.deviations[1]
    assert not found.failure and not found.held
    assert abs(camera.params[0] - 900) < 3 * deviations["fx"] and deviations["fx"] < 20
    assert found.model.num_points3D() > 250
    assert all(np.isfinite(point.xyz).all() for point in found.model.points3D.values())


def test_a_photo_that_no_pair_in_the_database_connects_stays_in_the_model(mapped):
    model, database = mapped(photos=6)
    with open_database(database) as known:
        for other in range(2, 7):
            known.delete_two_view_geometry(1, other)

    found = adjust(model, database)

    assert sorted(found.model.reg_image_ids()) == [1, 2, 3, 4, 5, 6]
    assert abs(found.model.cameras[1].params[0] - 900) < 3 * found.deviations[1]["fx"]


def test_photos_from_one_place_leave_numbers_or_the_model_as_it_was(mapped):
    model, database = mapped()
    for image in model.images.values():
        pose = image.cam_from_world()
        pose.translation = pose.rotation.matrix() @ (model.images[1].cam_from_world().inverse().translation * -1.0)
        model.frames[image.frame_id].set_cam_from_world(image.camera_id, pose)

    found = adjust_or_keep(model, database)

    assert found.failure or found.deviations[1]["fx"] > 1.0
    assert np.isfinite(found.model.cameras[1].params).all()
    assert all(np.isfinite(list(values.values())).all() for values in found.deviations.values())


def test_a_model_that_loses_its_points_stays_as_mapping_left_it(mapped):
    model, database = mapped()
    for key, image in model.images.items():
        pose = image.cam_from_world()
        pose.rotation = pycolmap.Rotation3d(np.array([key, 1.0, -key, 2.0]) / np.hypot(np.sqrt(2) * key, np.sqrt(5)))
        model.frames[image.frame_id].set_cam_from_world(image.camera_id, pose)

    with pytest.raises(NumericalError, match=r"only \d+ of \d+ points remain"):
        adjust(model, database)
    found = adjust_or_keep(model, database)

    assert found.model is model and "points" in found.failure
    assert found.model.cameras[1].params.tolist() == [880.0, 500.0, 400.0, 0.0]
    assert (found.deviations, found.determined) == ({1: {}}, {1: ()})


def test_a_camera_without_a_focal_length_stays_as_mapping_left_it(mapped):
    model, database = mapped(start=(np.nan, 500.0, 400.0, 0.0))

    found = adjust_or_keep(model, database)

    assert found.failure == "a camera has no focal length" and found.model is model


@pytest.mark.parametrize(
    ("error", "expected"),
    [(np.linalg.LinAlgError("Singular matrix"), None), (ZeroDivisionError("division by zero"), None),
     (RuntimeError("out of memory"), BackendError)],
)  # fmt: skip
def test_what_fails_in_our_numbers_is_a_reason_and_what_fails_in_colmap_an_error(mapped, monkeypatch, error, expected):
    def failing(*_):
        raise error

    model, database = mapped()
    where, name = (bundle_rounds, "reduce") if expected is None else (bundle, "find_correspondences")
    monkeypatch.setattr(where, name, failing)
    if expected:
        with pytest.raises(expected, match=str(error)):
            adjust_or_keep(model, database)
    else:
        assert str(error) in adjust_or_keep(model, database).failure
