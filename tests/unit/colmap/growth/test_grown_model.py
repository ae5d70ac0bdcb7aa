import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import open_database
from sfm_app.colmap.growth import model_in_database
from sfm_app.colmap.model import posed_photo_ids


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Five photos of a synthetic scene: the database, the model on disk, and how many keypoints photos have."""
    place = tmp_path_factory.mktemp("grown")
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 5, 50
    with open_database(place / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
        counts = {key: len(database.read_keypoints(key)) for key in model.images}
    camera = model.cameras[1]
    camera.params = [1.01 * value for value in camera.params]  # as refined by the last adjustment
    (place / "sparse").mkdir()
    model.write(place / "sparse")
    return place, model, counts


def test_known_photos_have_their_poses_points_and_refined_camera(made):
    place, model, counts = made

    part = model_in_database(place / "database.db", place / "sparse", {1, 2, 4}, counts)

    assert posed_photo_ids(part) == [1, 2, 4] and len(part.images) == 5
    for photo in (1, 2, 4):
        pose, true = (one.images[photo].cam_from_world().matrix() for one in (part, model))
        assert np.allclose(pose, true, atol=1e-12)
    assert np.allclose(part.cameras[1].params, model.cameras[1].params)
    assert 20 < part.num_points3D() <= model.num_points3D()
    tracks = [{element.image_id for element in point.track.elements} for point in part.points3D.values()]
    assert all(len(track) >= 2 and track <= {1, 2, 4} for track in tracks)


def test_keypoints_that_only_the_earlier_run_had_are_left_out(made):
    place, model, counts = made
    fewer = counts | {1: 10}

    part = model_in_database(place / "database.db", place / "sparse", set(counts), fewer)

    used = {element.point2D_idx for point in part.points3D.values() for element in point.track.elements
            if element.image_id == 1}  # fmt: skip
    assert used and max(used) < 10
    assert part.num_points3D() <= model.num_points3D()
