"""How well each photo is tied to a finished model: its points, their residuals, and where in the photo they lie."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.bearings import BEARING, RAY
from sfm_app.camera.models import camera_matrix, panorama_matrix
from sfm_app.colmap.backend import all_images, all_points, pycolmap, run_in_daemon_thread, translate_errors
from sfm_app.colmap.database import open_database
from sfm_app.geometry.epipolar import TwoViewSeed
from sfm_app.geometry.poses import Similarity
from sfm_app.numerical import finite_entries
from sfm_app.types import CameraModel, Frustum, Model, PairId, Scene, SceneArrays, Surface

# COLMAP's sparse model: build it from our two-view seed, divide and transform it, and read it.

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
    """Give a photo of a model its pose, in place."""
    image = model.images[photo]
    model.frames[image.frame_id].set_cam_from_world(image.camera_id, cam_from_world)
    model.register_frame(image.frame_id)


def model_from_seed(
    database: Path, pair: PairId, matches: NDArray[np.uint32], seed: TwoViewSeed
) -> pycolmap.Reconstruction:
    """Return a reconstruction of two photos with our pose and our points.

    Args:
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
    """Give every point the mean color of its pixels."""
    run_in_daemon_thread(lambda: model.extract_colors_for_all_images(photo_dir, num_threads=workers))


def submodel(model: pycolmap.Reconstruction, photos: Sequence[int]) -> pycolmap.Reconstruction:
    """Return a copy of a model with only the given photos, and the points that at least two of them see."""
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
    """Return the finite points of a model, or a sample of them drawn with a fixed seed."""
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
    """Return K (3, 3) of a camera; of a panorama, the scale at its middle."""
    if camera.is_spherical():
        return panorama_matrix((camera.width, camera.height))
    return np.asarray(camera.calibration_matrix(), np.float64)


def viewing_rays(model: pycolmap.Reconstruction, image_id: int, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the viewing directions (N, 3) of pixels of a photo in the world, of any length.

    Args:
        x: (N, 2) pixels.
    """
    image = model.images[image_id]
    R = image.cam_from_world().matrix()[:, :3]
    return np.asarray(bearing_vectors(model.cameras[image.camera_id], np.asarray(x, np.float64))[:, RAY] @ R)


def focal_px(model: pycolmap.Reconstruction, image_id: int) -> float:
    """Return the focal length of the camera of a photo, in pixels."""
    return float(np.sqrt(np.prod(np.diag(scale_matrix(model.cameras[model.images[image_id].camera_id]))[:2])))


def move(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Move a model into another frame.

    Args:
        similarity: from the frame of the model into the new one.
    """
    rotation = pycolmap.Rotation3d(similarity.R)
    model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.t))


# COLMAP's sparse model as plain arrays.


def model_arrays(model: pycolmap.Reconstruction, *, metric: bool) -> SceneArrays:
    """Return poses, cameras, points and tracks of a model.

    Args:
        metric: whether its unit is the meter.
    """
    images = sorted(posed_images(model), key=lambda image: image.name)
    cameras = [model.cameras[image.camera_id] for image in images]
    found = [model.points3D[key] for key in sorted(model.points3D)]
    rows = {image.image_id: row for row, image in enumerate(images)}
    keypoints = [np.array([point.xy for point in image.points2D], np.float64).reshape(-1, 2) for image in images]
    seen = [
        (row, rows[member.image_id], member.point2D_idx)
        for row, point in enumerate(found)
        for member in point.track.elements
        if member.image_id in rows
    ]
    point, photo, keypoint = np.array(seen, np.int64).reshape(-1, 3).T
    starts = np.cumsum([0, *map(len, keypoints)])
    pixels = np.concatenate([*keypoints, np.zeros((0, 2))])[starts[photo] + keypoint]
    poses = [image.cam_from_world().matrix() for image in images]
    return SceneArrays(
        photos=tuple(image.name for image in images),
        cam_from_world=np.array(poses, np.float64).reshape(-1, 3, 4),
        K=np.array([scale_matrix(camera) for camera in cameras], np.float64).reshape(-1, 3, 3),
        sizes=np.array([(camera.width, camera.height) for camera in cameras], np.int64).reshape(-1, 2),
        points=np.array([point.xyz for point in found], np.float64).reshape(-1, 3),
        colors=np.array([point.color for point in found], np.uint8).reshape(-1, 3),
        errors_px=np.array([point.error for point in found], np.float64),
        track_points=point,
        track_photos=photo,
        track_pixels=pixels,
        metric=metric,
    )


# COLMAP's sparse model on disk, as a scene and as points with cameras.

MIN_CONFIRMED_POINTS = 100
"""Points seen by three or more photos from which on their bounding box limits the scene."""


def read_model(model_dir: Path, frame: Similarity | None = None) -> pycolmap.Reconstruction:
    """Read a model on disk.

    Args:
        frame: from its frame into the one that is wanted; None for its own.
    """
    with translate_errors("reading the sparse model"):
        model = pycolmap.Reconstruction(model_dir)
        if frame is not None:
            move(model, frame)
    return model


def sparse_model(model_dir: Path) -> Model:
    """Return the colored points of a model on disk, and its posed photos as frusta, in order of ids.

    No third photo confirms points that only two photos see. Wrong ones among them lie far away and would shrink the
    scene to a dot in a viewer, so points outside the bounding box of the confirmed points are left out.

    Raises:
        BackendError: it cannot be read.
    """
    model = read_model(model_dir)
    found = [model.points3D[key] for key in sorted(model.points3D) if finite_mask(model.points3D[key].xyz)]
    places = np.array([point.xyz for point in found], np.float64).reshape(-1, 3)
    colors = np.array([point.color for point in found], np.uint8).reshape(-1, 3)
    confirmed = np.array([point.track.length() > 2 for point in found], bool)
    if np.count_nonzero(confirmed) >= MIN_CONFIRMED_POINTS:
        low, high = places[confirmed].min(axis=0), places[confirmed].max(axis=0)
        inside = ((places >= low) & (places <= high)).all(axis=1)
        places, colors = places[inside], colors[inside]
    cameras = tuple(_frustum(image, model.cameras[image.camera_id]) for image in posed_images(model))
    return Model(Surface(places, np.zeros((0, 3), np.int64), colors), cameras=cameras)


def _frustum(image: pycolmap.Image, camera: pycolmap.Camera) -> Frustum:
    K, pose = scale_matrix(camera), image.cam_from_world().matrix()
    if camera.is_spherical():  # drawn as a view of 90 degrees to its front
        K = camera_matrix(camera.width / 2, camera.width / 2, camera.width / 2, camera.height / 2)
    return Frustum(image.name, K, np.asarray(pose, np.float64), camera.width, camera.height)


class RefinedCamera(TypedDict, total=False):
    """Facts about a refined camera that COLMAP's model does not hold; as in `CameraModel`."""

    deviations: Mapping[str, float | None]
    determined: Sequence[str]
    correlations: Mapping[str, float | None]


def read_scene(
    model_dir: Path, names: Mapping[str, str], unregistered: Mapping[str, str], refined: Mapping[str, RefinedCamera]
) -> Scene:
    """Read a model on disk as the scene that later stages use.

    Args:
        names, unregistered: the name of its camera, by photo; the reason why it has no pose, by photo.
        refined: deviations, determined parameters and correlations, by camera; may lack cameras.
    """
    model = pycolmap.Reconstruction(model_dir)
    posed = posed_images(model)
    ids = {names[image.name]: image.camera_id for image in posed}
    return Scene(
        model_dir=model_dir,
        cam_from_world={image.name: np.asarray(image.cam_from_world().matrix(), np.float64) for image in posed},
        unregistered=dict(unregistered),
        cameras={name: _camera(model.cameras[key], refined.get(name, {})) for name, key in ids.items()},
        points=model.num_points3D(),
        observations=model.compute_num_observations(),
        mean_reprojection_px=float(model.compute_mean_reprojection_error()),
        camera_of={image.name: names[image.name] for image in posed},
    )


def _camera(camera: pycolmap.Camera, refined: RefinedCamera) -> CameraModel:
    K = scale_matrix(camera)
    params = tuple(float(value) for value in camera.params)
    deviations, determined = finite_entries(refined.get("deviations", {})), tuple(refined.get("determined", ()))
    correlations = finite_entries(refined.get("correlations", {}))
    return CameraModel(camera.model.name, params, K, camera.width, camera.height, deviations, determined, correlations)


CELLS = 8
"""Cells along each side of a photo whose share with points is its coverage. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class PhotoObservations:
    """What one photo sees of a model."""

    points: int
    residual_px: float
    """Mean distance between its keypoints and the points that they observe; NaN without any."""
    coverage: float
    """Share of its cells with a point in them."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelFigures:
    """Figures of a model."""

    photos: dict[str, PhotoObservations]
    """By name, of the posed photos."""
    tracks: NDArray[np.int64]
    """(P,) how many photos see each point."""
    places: NDArray[np.float64]
    """(P, 3) the points."""


def model_figures(model_dir: Path) -> ModelFigures:
    """Return the figures of a model on disk.

    Raises:
        BackendError: it cannot be read.
    """
    with translate_errors("reading the sparse model"):
        model = pycolmap.Reconstruction(model_dir)
        places = {key: np.asarray(point.xyz) for key, point in model.points3D.items()}
        photos = {image.name: _observe(image, model.cameras[image.camera_id], places) for image in posed_images(model)}
        keys = [key for key in sorted(places) if finite_mask(places[key])]
        tracks = np.array([model.points3D[key].track.length() for key in keys], np.int64)
    return ModelFigures(photos, tracks, np.array([places[key] for key in keys]).reshape(-1, 3))


def _observe(
    image: pycolmap.Image, camera: pycolmap.Camera, places: dict[int, NDArray[np.float64]]
) -> PhotoObservations:
    seen = image.get_observation_points2D()
    if not seen:
        return PhotoObservations(0, float("nan"), 0.0)
    pixels = np.array([point.xy for point in seen], np.float64)
    pose = image.cam_from_world().matrix()
    local = np.array([places[point.point3D_id] for point in seen]) @ pose[:, :3].T + pose[:, 3]
    off = np.linalg.norm(np.asarray(camera.img_from_cam(local), np.float64) - pixels, axis=1)
    cells = np.clip(pixels / (camera.width, camera.height) * CELLS, 0, CELLS - 1).astype(np.int64)
    coverage = len(np.unique(cells[:, 1] * CELLS + cells[:, 0])) / CELLS**2
    return PhotoObservations(len(seen), float(np.nanmean(off)), coverage)
