"""COLMAP's SQLite database: photos and cameras in, keypoints and matches out, our epipolar geometries and K back in."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import pycolmap
from sfm_app.geometry.camera import guessed_camera_matrix
from sfm_app.types import Calibration, EpipolarFit, MatchedImage, MatchGraph, PairId, PhotoSet

SQUARE_PIXELS = "SIMPLE_RADIAL"
"""f, cx, cy, k: what is mapped with where K has one focal; a second radial term runs wild on the first few photos."""

TWO_FOCALS = "OPENCV"
"""fx, fy, cx, cy, k1, k2, p1, p2: COLMAP's smallest model that holds a camera matrix with two focals and a lens."""


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The database, closed whatever happens."""
    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


def create_database(path: Path, photo_dir: Path, photos: PhotoSet) -> None:
    """Enter photos and cameras in a fixed order.

    Feature extraction would do it too, but numbers photos as its threads finish with them: not twice the same.
    """
    with opened(path):
        pass
    for members in photos.groups.values():
        K = guessed_camera_matrix((members[0].width, members[0].height))
        options = pycolmap.ImageReaderOptions()
        options.camera_model = SQUARE_PIXELS
        options.camera_params = ",".join(str(value) for value in camera_params(K, SQUARE_PIXELS))
        names = [photo.name for photo in members]
        pycolmap.import_images(path, photo_dir, pycolmap.CameraMode.SINGLE, names, options)


def read_match_graph(path: Path, photos: PhotoSet) -> MatchGraph:
    """Keypoints and raw matches of every photo in the database."""
    by_name = {photo.name: photo for photo in photos.photos}
    with opened(path) as database:
        images, keypoints = {}, {}
        for entry in sorted(database.read_all_images(), key=lambda entry: entry.image_id):
            photo = by_name[entry.name]
            images[entry.image_id] = MatchedImage(
                entry.image_id, photo.name, photo.group, photo.width, photo.height, photo.exif_focal_px
            )
            found = database.read_keypoints(entry.image_id)
            keypoints[entry.image_id] = np.asarray(found, np.float64).reshape(len(found), -1)[:, :2].copy()
        pair_ids, rows = database.read_all_matches()
    matches = {_pair(pair_id): np.asarray(row, np.uint32) for pair_id, row in zip(pair_ids, rows, strict=True)}
    return MatchGraph(images, keypoints, dict(sorted(matches.items())))


def write_epipolar_fits(path: Path, matches: MatchGraph, fits: Mapping[PairId, EpipolarFit]) -> None:
    """Replace all two-view geometries by ours."""
    with opened(path) as database, pycolmap.DatabaseTransaction(database):
        database.clear_two_view_geometries()
        for pair, fit in fits.items():
            database.write_two_view_geometry(*pair, _two_view_geometry(fit, matches.matches[pair]))


def write_calibrations(path: Path, matches: MatchGraph, cameras: Mapping[str, Calibration]) -> None:
    """Give every camera its K; a K that the photos determine counts as prior knowledge, a guess does not."""
    groups = {image.id: image.group for image in matches.images.values()}
    with opened(path) as database, pycolmap.DatabaseTransaction(database):
        for entry in database.read_all_images():
            calibration = cameras[groups[entry.image_id]]
            camera = database.read_camera(entry.camera_id)
            camera_model = SQUARE_PIXELS if calibration.K[0, 0] == calibration.K[1, 1] else TWO_FOCALS
            camera.model = getattr(pycolmap.CameraModelId, camera_model)
            camera.params = camera_params(calibration.K, camera_model)
            camera.has_prior_focal_length = calibration.identifiable
            database.update_camera(camera)


def camera_params(K: NDArray[np.float64], camera_model: str, radial: float = 0.0) -> list[float]:
    """COLMAP's parameters for a camera matrix and a first radial term."""
    fx, fy, cx, cy = (float(K[row, column]) for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if camera_model == SQUARE_PIXELS:
        return [(fx * fy) ** 0.5, cx, cy, radial]
    return [fx, fy, cx, cy, radial, 0.0, 0.0, 0.0]


def _pair(pair_id: int) -> PairId:
    first, second = pycolmap.pair_id_to_image_pair(pair_id)
    return int(first), int(second)


def _two_view_geometry(fit: EpipolarFit, matches: NDArray[np.uint32]) -> Any:
    geometry = pycolmap.TwoViewGeometry()
    kinds = pycolmap.TwoViewGeometryConfiguration
    geometry.config = kinds.PLANAR_OR_PANORAMIC if fit.degeneracy else kinds.UNCALIBRATED
    geometry.F = fit.F
    geometry.inlier_matches = np.ascontiguousarray(matches[fit.inliers])
    return geometry
