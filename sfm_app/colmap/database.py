"""COLMAP's SQLite database: photos, cameras, features, matches and relative poses."""

import contextlib
import ctypes
import hashlib
import sqlite3
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.models import FAMILIES, file_model, guessed_camera_matrix, params_of_row, row_of_calibration
from sfm_app.colmap.backend import pycolmap
from sfm_app.geometry.epipolar import cross_matrix
from sfm_app.types import (
    Calibration,
    Intrinsics,
    MatchedImage,
    MatchGraph,
    PairId,
    Photo,
    PhotoSet,
    PoseGraph,
    RelativePose,
)
from sfm_app.types.arrays import ByteArray, Float32Array, FloatArray
from sfm_app.types.camera import EQUIRECTANGULAR, PERSPECTIVE

SQUARE_PIXELS = "SIMPLE_RADIAL"
"""f, cx, cy, k: the model for mapping with one focal; a second radial term diverges on the first photos."""
PANORAMA = "EQUIRECTANGULAR"
"""w, h: the model of panoramas."""

KINDS = {
    "calibrated": "CALIBRATED", "uncalibrated": "UNCALIBRATED", "planar": "PLANAR", "rotation": "PANORAMIC"
}  # fmt: skip


@contextlib.contextmanager
def open_database(path: Path) -> Iterator[pycolmap.Database]:
    """Provide an open database."""
    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        try:
            database.close()
        except RuntimeError:  # the disk is full; the destructor would close it once more, which ends the program
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(database))
            raise


def is_sound(path: Path) -> bool:
    """Return whether a database is intact, after SQLite has rolled back an unfinished transaction."""
    if not path.is_file():
        return False
    try:
        with contextlib.closing(sqlite3.connect(path)) as connection:
            return bool(connection.execute("PRAGMA quick_check(1)").fetchone() == ("ok",))
    except sqlite3.Error:
        return False


MATCH_QUERIES = (
    "SELECT sql FROM sqlite_master ORDER BY name",
    "SELECT image_id, name FROM images ORDER BY image_id",
    "SELECT image_id, rows, cols, data FROM keypoints ORDER BY image_id",
    "SELECT pair_id, rows, cols, data FROM matches ORDER BY pair_id",
)
"""Tables that no longer change once the photos are matched."""


def digest_matches(path: Path) -> str:
    """Return the hash of photos, keypoints and matches."""
    digest = hashlib.blake2b(digest_size=16)
    with contextlib.closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True)) as connection:
        for query in MATCH_QUERIES:
            for row in connection.execute(query):
                for value in row:
                    digest.update(value if isinstance(value, bytes) else repr(value).encode())
                    digest.update(b"\0")
    return digest.hexdigest()


def remove_database(path: Path) -> None:
    """Remove a database and the files that SQLite keeps beside it."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def create_database(path: Path, photos: PhotoSet) -> None:
    """Make a database of photos and cameras in a fixed order, which threads of feature extraction would not keep."""
    images = {key: matched_image(key, photo) for key, photo in enumerate(ordered_photos(photos), start=1)}
    write_match_graph(path, MatchGraph(images, {}, {}))


def ordered_photos(photos: PhotoSet) -> list[Photo]:
    """Return the photos in the order of their ids: by group, then by name."""
    return [photo for group in photos.groups.values() for photo in sorted(group, key=lambda photo: photo.name)]


def matched_image(key: int, photo: Photo) -> MatchedImage:
    """Return a photo with its id."""
    return MatchedImage(
        key, photo.name, photo.group, photo.width, photo.height,
        photo.prior, photo.gps, photo.turn_deg, photo.shown, photo.projection, photo.time_s,
    )  # fmt: skip


def read_match_graph(path: Path, photos: PhotoSet) -> MatchGraph:
    """Return keypoints and raw matches of every photo in the database, which was made from these photos."""
    by_name = {photo.name: photo for photo in photos.photos}
    images = {key: matched_image(key, by_name[name]) for key, name in photo_names(path).items()}
    found, matches = read_features(path)
    keypoints = {key: found.get(key, np.zeros((0, 2))) for key in images}  # none on a white wall
    return MatchGraph(images, keypoints, {pair: rows for pair, rows in sorted(matches.items()) if len(rows)})


def panorama_names(path: Path) -> frozenset[str]:
    """Return the names of the photos that are equirectangular panoramas."""
    model = pycolmap.CameraModelId.__members__[PANORAMA]
    with open_database(path) as database:
        cameras = {camera.camera_id for camera in database.read_all_cameras() if camera.model == model}
        return frozenset(image.name for image in database.read_all_images() if image.camera_id in cameras)


def photo_names(path: Path) -> dict[int, str]:
    """Return the names of all photos by id."""
    with open_database(path) as database:
        return {entry.image_id: entry.name for entry in sorted(database.read_all_images(), key=lambda e: e.image_id)}


def unmatched_pairs(path: Path, pairs: Sequence[PairId]) -> list[PairId]:
    """Return the pairs, with ids in any order, without an entry of matches in the database, not even an empty one."""
    with open_database(path) as database:
        return [pair for pair in pairs if not database.exists_matches(*pair)]


def write_keypoints(path: Path, photo: int, keypoints: Float32Array) -> None:
    """Enter the keypoints (N, 2) of a photo in pixels, or replace them."""
    with open_database(path) as database:
        _put_keypoints(database, photo, keypoints)


def _put_keypoints(database: pycolmap.Database, photo: int, keypoints: NDArray[np.floating]) -> None:
    write = database.update_keypoints if database.exists_keypoints(photo) else database.write_keypoints
    write(photo, np.ascontiguousarray(keypoints, np.float32))


def write_matches(path: Path, pair: PairId, rows: NDArray[np.uint32]) -> None:
    """Enter the matches (M, 2) of a pair that has none; the smaller id comes first."""
    with open_database(path) as database:
        database.write_matches(*pair, np.ascontiguousarray(rows, np.uint32))


def write_match_graph(path: Path, matches: MatchGraph) -> None:
    """Make or replace a database of the photos, keypoints and raw matches of a match graph, with the same ids.

    Its cameras are guesses, one for each group of photos, until `write_calibrations` replaces them.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_database(path)
    groups = dict.fromkeys(image.group for _, image in sorted(matches.images.items()))
    numbers = {group: number for number, group in enumerate(groups, start=1)}
    with open_database(path) as database:
        for photo, known in sorted(matches.images.items()):
            camera_id = numbers[known.group]
            if not database.exists_camera(camera_id):
                _write_camera(database, camera_id, _guess_calibration(known))
            image = pycolmap.Image(name=known.name, camera_id=camera_id, image_id=photo)
            database.write_image(image, use_image_id=True)
            _write_frame(database, image)
        for photo, keypoints in matches.keypoints.items():
            _put_keypoints(database, photo, keypoints)
        for pair, rows in matches.matches.items():
            database.write_matches(*pair, np.ascontiguousarray(rows, np.uint32))


def read_features(path: Path) -> tuple[dict[int, FloatArray], dict[PairId, NDArray[np.uint32]]]:
    """Return keypoints (N, 2) of every photo that has any, and the raw matches of pairs."""
    with open_database(path) as database:
        features = {image.image_id: database.read_keypoints(image.image_id) for image in database.read_all_images()}
        pair_ids, rows = database.read_all_matches()
    keypoints = {photo: np.asarray(x, np.float64)[:, :2].copy() for photo, x in sorted(features.items()) if len(x)}
    return keypoints, {_pair(key): np.asarray(row, np.uint32) for key, row in zip(pair_ids, rows, strict=True)}


def write_pose_graph(path: Path, matches: MatchGraph, graph: PoseGraph) -> None:
    """Replace all two-view geometries by our relative poses and their essential matrices."""
    with open_database(path) as database:
        database.clear_two_view_geometries()
        for pair, pose in graph.poses.items():
            database.write_two_view_geometry(*pair, _two_view_geometry(pose, matches.matches[pair]))


def keep_raw_matches(path: Path, pairs: Collection[PairId]) -> None:
    """Remove all two-view geometries, and the matches of all other pairs."""
    with open_database(path) as database:
        database.clear_two_view_geometries()
        for pair in {_pair(pair_id) for pair_id in database.read_all_matches()[0]}.difference(pairs):
            database.delete_matches(*pair)


def write_calibrations(path: Path, matches: MatchGraph, intrinsics: Intrinsics) -> None:
    """Replace all cameras by ours, with K and lens, and assign one to every photo.

    Cameras are numbered in the order of their first photos, whatever the database held before. A K that the photos
    determine is marked as a prior focal length, a guess is not.
    """
    used = {image.id: intrinsics.camera_name(image) for image in matches.images.values()}
    ids = {name: number for number, name in enumerate(dict.fromkeys(used[key] for key in sorted(used)), start=1)}
    with open_database(path) as database:
        database.clear_frames()
        database.clear_rigs()
        for name, camera_id in ids.items():
            _write_camera(database, camera_id, intrinsics.cameras[name])
        for image in database.read_all_images():
            image.camera_id = ids[used[image.image_id]]
            database.update_image(image)
            _write_frame(database, image)
    # pycolmap can only clear all cameras at once, and only while no image refers to one
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("DELETE FROM cameras WHERE camera_id > ?", (len(ids),))


def _guess_calibration(photo: MatchedImage) -> Calibration:
    """Return a guess of the camera of a photo; that of a panorama is exact."""
    size = photo.width, photo.height
    return Calibration(guessed_camera_matrix(size), *size, "guess", False, projection=photo.projection)


def _write_camera(database: pycolmap.Database, camera_id: int, calibration: Calibration) -> None:
    """Write or replace a camera, and the rig of one sensor that COLMAP requires for it."""
    name = camera_model(calibration)
    camera = pycolmap.Camera(
        camera_id=camera_id,
        model=pycolmap.CameraModelId.__members__[name],
        width=calibration.width,
        height=calibration.height,
        params=params_of_row(row_of_calibration(calibration), name),
        has_prior_focal_length=calibration.is_estimated,
    )
    if database.exists_camera(camera_id):
        database.update_camera(camera)
    else:
        database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)


def _write_frame(database: pycolmap.Database, image: pycolmap.Image) -> None:
    """Write the frame of a single photo, which COLMAP requires for it."""
    frame = pycolmap.Frame(frame_id=image.image_id, rig_id=image.camera_id)
    frame.add_data_id(image.data_id)
    database.write_frame(frame, use_frame_id=True)


def camera_model(calibration: Calibration) -> str:
    """Return COLMAP's name of the smallest camera model for a calibration."""
    if calibration.projection == EQUIRECTANGULAR:
        return PANORAMA
    # largest |fy/fx - 1| of square pixels: calibrators give no more where the photos show no other aspect
    K, tolerance = calibration.K, 0.0 if calibration.is_given else 0.005
    square = "aspect" in calibration.held or K[0, 0] == K[1, 1] or abs(K[1, 1] / K[0, 0] - 1.0) < tolerance
    if square and calibration.projection == PERSPECTIVE and not calibration.has_more_terms:
        return SQUARE_PIXELS
    return file_model(row_of_calibration(calibration), FAMILIES[calibration.projection])


def _pair(pair_id: int) -> PairId:
    first, second = pycolmap.pair_id_to_image_pair(pair_id)
    return int(first), int(second)


def _two_view_geometry(pose: RelativePose, matches: NDArray[np.uint32]) -> pycolmap.TwoViewGeometry:
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.__members__[KINDS[pose.kind]]
    geometry.E = cross_matrix(pose.t) @ pose.R
    geometry.cam2_from_cam1 = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.R), pose.t)
    geometry.tri_angle = float(np.radians(pose.angle_deg))
    geometry.inlier_matches = np.ascontiguousarray(matches[pose.inliers])
    return geometry


def largest_descriptors(path: Path, photo: int, most: int) -> ByteArray:
    """Return descriptors (N, 128) of the `most` largest features of a photo, largest first; none where it has none."""
    with open_database(path) as database:
        if not database.exists_descriptors(photo):
            return np.zeros((0, 128), np.uint8)
        descriptors = np.asarray(database.read_descriptors(photo).data, np.uint8).reshape(-1, 128)
        shapes = np.asarray(database.read_keypoints(photo), np.float64)[:, 2:]
    areas = np.abs(shapes[:, 0] * shapes[:, 3] - shapes[:, 1] * shapes[:, 2])
    return descriptors[np.argsort(-areas, kind="stable")[:most]]
