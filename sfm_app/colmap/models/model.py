"""COLMAP's sparse model: build it from our two-view seed, divide and transform it, and read it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import pycolmap, run_in_daemon_thread
from sfm_app.colmap.database import open_database
from sfm_app.colmap.types import all_images, all_points
from sfm_app.geometry.camera import panorama_matrix
from sfm_app.geometry.lenses.bearings import BEARING, RAY
from sfm_app.geometry.similarity import Similarity
from sfm_app.geometry.two_view_init import TwoViewSeed
from sfm_app.types import PairId

STEP_PX = 1e-3
"""Step of the derivatives of bearing vectors: curvature and rounding in double precision cost about 1e-9 of them."""
MAX_COORDINATE = 1e100
"""Largest coordinate of a finite point: squares of much larger ones overflow."""


def finite_mask(xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (...) which points (..., 3) are finite, and near enough that their distances do not overflow."""
    return np.asarray((np.abs(xyz) < MAX_COORDINATE).all(axis=-1))


def unposed_model(database: Path, *, unconnected: bool = True) -> pycolmap.Reconstruction:
    """Return a reconstruction of the photos, keypoints and cameras of a database, without poses and points.

    Args:
        database: holds photos, keypoints and two-view geometries.
        unconnected: whether photos are in it that no pair in the database connects.
    """
    options = pycolmap.DatabaseCacheOptions()
    options.load_all_images = unconnected
    with open_database(database) as db:
        cache = pycolmap.DatabaseCache.create(db, options)
    model = pycolmap.Reconstruction()
    model.load(cache)
    return model


def pose_photo(model: pycolmap.Reconstruction, photo: int, cam_from_world: pycolmap.Rigid3d) -> None:
    """Give a photo of a model its pose, in place.

    Args:
        model: COLMAP's reconstruction.
        photo: id.
        cam_from_world: the pose.
    """
    image = model.images[photo]
    model.frames[image.frame_id].set_cam_from_world(image.camera_id, cam_from_world)
    model.register_frame(image.frame_id)


def model_from_seed(
    database: Path, pair: PairId, matches: NDArray[np.uint32], seed: TwoViewSeed
) -> pycolmap.Reconstruction:
    """Return a reconstruction of two photos with our pose and our points.

    Args:
        database: holds photos, keypoints and two-view geometries.
        pair: ids of the two photos.
        matches: (N, 2) keypoint indices, one row per point of the seed.
        seed: pose and points; only its usable points are added.
    """
    model = unposed_model(database, unconnected=False)
    for photo, R, t in ((pair[0], np.eye(3), np.zeros(3)), (pair[1], seed.R, seed.t)):
        pose_photo(model, photo, pycolmap.Rigid3d(pycolmap.Rotation3d(R), t))
    for index in np.flatnonzero(seed.usable):
        track = pycolmap.Track()
        track.add_element(pair[0], int(matches[index, 0]))
        track.add_element(pair[1], int(matches[index, 1]))
        model.add_point3D(seed.points[index], track, np.zeros(3, np.uint8))
    return model


@dataclass(frozen=True, slots=True, eq=False)
class PlacedView:
    """A posed photo and the bearing vectors of its keypoints."""

    R: NDArray[np.float64]
    """(3, 3) rotation, camera from world."""
    t: NDArray[np.float64]
    """(3,) translation, camera from world."""
    lines: NDArray[np.float64]
    """(N, 9) bearing vectors of keypoints, see `geometry.lenses.bearings`."""


def placed_views(model: pycolmap.Reconstruction, keypoints: Mapping[int, NDArray[np.float64]]) -> dict[int, PlacedView]:
    """Return all photos of a model that have a pose, by id.

    Args:
        model: COLMAP's reconstruction.
        keypoints: (N, 2) pixels, by photo id.
    """
    found = {}
    for image in posed_images(model):
        camera, pose = model.cameras[image.camera_id], image.cam_from_world().matrix()
        lines = bearing_vectors(camera, keypoints[image.image_id])
        found[image.image_id] = PlacedView(pose[:, :3].copy(), pose[:, 3].copy(), lines)
    return found


def bearing_vectors(camera: pycolmap.Camera, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return bearing vectors (N, 9), as `geometry.lenses.bearings` does.

    Args:
        camera: COLMAP's camera.
        x: (N, 2) pixels.
    """
    if camera.is_perspective_fisheye() or camera.is_spherical():
        steps = np.vstack([x + step for step in ([0.0, 0.0], [STEP_PX, 0.0], [0.0, STEP_PX])])
        here, right, down = np.asarray(camera.cam_ray_from_img(steps), np.float64).reshape(3, -1, 3)
        return np.hstack([here, (right - here) / STEP_PX, (down - here) / STEP_PX])
    found = np.zeros((len(x), BEARING))
    found[:, :2], found[:, 2] = np.asarray(camera.cam_from_img(x), np.float64).reshape(-1, 2), 1.0
    found[:, 3], found[:, 7] = 1.0 / camera.focal_length_x, 1.0 / camera.focal_length_y
    return found


def posed_photo_ids(model: pycolmap.Reconstruction) -> list[int]:
    """Return the ids of the posed photos of a model, in order."""
    return [image.image_id for image in posed_images(model)]


class MappedCamera(NamedTuple):
    """A camera as mapping left it; see `Calibration`."""

    K: NDArray[np.float64]
    radial: float = 0.0
    fisheye: tuple[float, ...] = ()


def cameras_by_photo(model: pycolmap.Reconstruction) -> dict[int, MappedCamera]:
    """Return the camera of every posed photo, by photo id."""
    return {image.image_id: _mapped_camera(model.cameras[image.camera_id]) for image in posed_images(model)}


def _mapped_camera(camera: pycolmap.Camera) -> MappedCamera:
    if camera.is_spherical():
        return MappedCamera(panorama_matrix((camera.width, camera.height)))
    K, terms = (
        np.asarray(camera.calibration_matrix(), np.float64),
        [camera.params[k] for k in camera.extra_params_idxs()],
    )
    if camera.is_perspective_fisheye():
        if camera.model.name == "THIN_PRISM_FISHEYE":
            terms = [terms[k] for k in (0, 1, 4, 5)]
        return MappedCamera(K, fisheye=tuple(float(term) for term in terms))
    return MappedCamera(K, float(terms[0]))


def color_points(model: pycolmap.Reconstruction, photo_dir: Path, workers: int) -> None:
    """Give every point the mean color of its pixels.

    Args:
        model: changed in place.
        photo_dir: folder with the photos.
        workers: threads.
    """
    run_in_daemon_thread(lambda: model.extract_colors_for_all_images(photo_dir, num_threads=workers))


def submodel(model: pycolmap.Reconstruction, photos: Sequence[int]) -> pycolmap.Reconstruction:
    """Return a copy of a model with only the given photos, and the points that at least two of them see.

    Args:
        model: not changed.
        photos: ids of the photos to keep.
    """
    part, members = pycolmap.Reconstruction(model), set(photos)
    for image in posed_images(model):
        if image.image_id not in members:
            part.deregister_frame(image.frame_id)
    part.tear_down()  # with frames that have no pose, no covariance can be estimated
    return part


def points_by_keypoint(model: pycolmap.Reconstruction) -> dict[tuple[int, int], tuple[int, NDArray[np.float64]]]:
    """Return the id and position (3,) of the 3D point of each keypoint in a track, by photo and keypoint index."""
    return {
        (element.image_id, element.point2D_idx): (key, np.asarray(point.xyz, np.float64))
        for key, point in all_points(model)
        for element in point.track.elements
    }


def posed_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Return the posed photos of a model, in order of ids."""
    return sorted((image for image in all_images(model) if image.has_pose), key=lambda image: image.image_id)


def poses_and_points(model: pycolmap.Reconstruction) -> tuple[dict[int, NDArray[np.float64]], NDArray[np.float64]]:
    """Return (3, 4) cam_from_world of the posed photos by id, in order of ids, and the points (P, 3)."""
    poses = {image.image_id: np.asarray(image.cam_from_world().matrix(), np.float64) for image in posed_images(model)}
    points = np.array([model.points3D[key].xyz for key in sorted(model.points3D)]).reshape(-1, 3)
    return poses, points


@dataclass(frozen=True, slots=True, eq=False)
class SeenPoints:
    """Points of a model, and the photos that see them."""

    points: NDArray[np.float64]
    """(P, 3)"""
    colors: NDArray[np.uint8]
    """(P, 3)"""
    seen: tuple[NDArray[np.int64], ...]
    """For each posed photo, in order of ids, the rows of the points that it sees."""


def seen_points(model: pycolmap.Reconstruction, most: int) -> SeenPoints:
    """Return the finite points of a model, or a sample of them drawn with a fixed seed.

    Args:
        model: COLMAP's reconstruction, colored.
        most: largest number of points.
    """
    keys = [key for key in sorted(model.points3D) if finite_mask(model.points3D[key].xyz)]
    chosen = np.sort(np.random.default_rng(0).permutation(len(keys))[:most])
    found = [model.points3D[keys[k]] for k in chosen]
    seen: dict[int, list[int]] = {image_id: [] for image_id in posed_photo_ids(model)}
    for number, point in enumerate(found):
        for image_id in {element.image_id for element in point.track.elements} & seen.keys():
            seen[image_id].append(number)
    return SeenPoints(
        np.array([point.xyz for point in found], np.float64).reshape(-1, 3),
        np.array([point.color for point in found], np.uint8).reshape(-1, 3),
        tuple(np.array(numbers, np.int64) for numbers in seen.values()),
    )


def scale_matrix(camera: pycolmap.Camera) -> NDArray[np.float64]:
    """Return K (3, 3) of a camera; of a panorama, the scale at its middle.

    Args:
        camera: of any model.
    """
    if camera.is_spherical():
        return panorama_matrix((camera.width, camera.height))
    return np.asarray(camera.calibration_matrix(), np.float64)


def viewing_rays(model: pycolmap.Reconstruction, image_id: int, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the viewing directions (N, 3) of pixels of a photo in the world, of any length.

    Args:
        model: COLMAP's reconstruction.
        image_id: id of a posed photo.
        x: (N, 2) pixels.
    """
    image = model.images[image_id]
    R = image.cam_from_world().matrix()[:, :3]
    return np.asarray(bearing_vectors(model.cameras[image.camera_id], np.asarray(x, np.float64))[:, RAY] @ R)


def focal_px(model: pycolmap.Reconstruction, image_id: int) -> float:
    """Return the focal length of the camera of a photo, in pixels.

    Args:
        model: COLMAP's reconstruction.
        image_id: id of the photo.
    """
    return float(np.sqrt(np.prod(np.diag(scale_matrix(model.cameras[model.images[image_id].camera_id]))[:2])))


def move(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Move a model into another frame.

    Args:
        model: changed in place.
        similarity: from the frame of the model into the new one.
    """
    rotation = pycolmap.Rotation3d(similarity.R)
    model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.t))
