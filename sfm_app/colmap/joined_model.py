"""Join models: two by a similarity, or many as arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm_app.colmap.backend import Camera, Reconstruction, all_points, pycolmap, translate_errors
from sfm_app.colmap.bundle import drop_infinite_points, find_correspondences, improve_tracks, photos_per_camera, solve
from sfm_app.colmap.model import bearing_vectors, pose_photo, posed_images, unposed_model
from sfm_app.types.arrays import FloatArray, IndexArray


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPhotos:
    """Poses and points of a model."""

    photos: IndexArray
    """(I,) ids, sorted."""
    R: FloatArray
    """(I, 3, 3) rotations, camera from world."""
    centers: FloatArray
    """(I, 3) projection centers."""
    X: FloatArray
    """(P, 3) points."""
    point: IndexArray
    photo: IndexArray
    keypoint: IndexArray
    """(N,) each: row of the point of each observation, ascending; id of its photo; index of its keypoint."""
    cameras: Mapping[int, Camera]
    """Camera of each photo, by its id."""

    def bearings(self, photo: int, x: FloatArray) -> FloatArray:
        """Return the bearing vectors (N, 9) of pixels (N, 2) of a photo."""
        return bearing_vectors(self.cameras[photo], x)


def read_placed(model_dir: Path) -> PlacedPhotos:
    """Read a model on disk."""
    with translate_errors("reading the model of a part"):
        return placed_photos(Reconstruction(model_dir))


def placed_photos(model: Reconstruction) -> PlacedPhotos:
    """Return the poses and points of a model."""
    images = posed_images(model)
    poses = np.array([image.cam_from_world().matrix() for image in images], np.float64).reshape(-1, 3, 4)
    points = sorted(all_points(model), key=lambda entry: entry[0])
    tracks = [[(one.image_id, one.point2D_idx) for one in point.track.elements] for _, point in points]
    cameras = {image.image_id: Camera(model.cameras[image.camera_id].todict()) for image in images}
    X = np.array([point.xyz for _, point in points], np.float64).reshape(-1, 3)
    elements = np.array([element for track in tracks for element in track], np.int64).reshape(-1, 2)
    R = poses[:, :, :3]
    centers = -np.einsum("nji,nj->ni", R, poses[:, :, 3])
    point = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    photo, keypoint = elements.T
    return PlacedPhotos(np.array(sorted(cameras), np.int64), R, centers, X, point, photo, keypoint, cameras)


def write_placed(database: Path, placed: PlacedPhotos) -> Reconstruction:
    """Return poses and points as COLMAP's model, with the photos of a database and cameras of median focal."""
    model = unposed_model(database)
    _write_cameras(model, placed)
    for photo, R, center in zip(placed.photos.tolist(), placed.R, placed.centers, strict=True):
        pose_photo(model, photo, pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ center))
    starts = np.searchsorted(placed.point, np.arange(len(placed.X) + 1)).tolist()
    photos, keypoints = placed.photo.tolist(), placed.keypoint.tolist()
    for row, xyz in enumerate(placed.X):
        track = pycolmap.Track()
        for k in range(starts[row], starts[row + 1]):
            track.add_element(photos[k], keypoints[k])
        model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    model.tear_down()
    return model


def with_cameras_of(database: Path, model: Reconstruction) -> Reconstruction:
    """Return a model with the cameras that a database names for its photos, adjusted with their focals."""
    found = write_placed(database, placed_photos(model))
    adjust_joined(found, database, sorted(photos_per_camera(found)))
    return found


def _write_cameras(model: Reconstruction, placed: PlacedPhotos) -> None:
    ranked_focals: dict[int, list[tuple[float, int]]] = {}
    for photo in placed.photos.tolist():
        known = placed.cameras[photo]
        focal = 0.0 if known.is_spherical() else known.mean_focal_length()
        ranked_focals.setdefault(model.images[photo].camera_id, []).append((focal, photo))
    for camera_id, ranked in ranked_focals.items():
        camera, known = model.cameras[camera_id], placed.cameras[sorted(ranked)[len(ranked) // 2][1]]
        camera.model, camera.params = known.model, known.params.tolist()


def adjust_joined(model: Reconstruction, database: Path, refined: Sequence[int]) -> None:
    """Adjust a joined model and the focals of `refined` cameras in place, and complete, merge and filter its tracks."""
    drop_infinite_points(model)
    graph = find_correspondences(model, database)
    for _ in range(2):
        solve(model, refined)
        improve_tracks(model, graph)
