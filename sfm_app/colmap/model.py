"""COLMAP's sparse model: build, divide and move it, read it as arrays, as a scene, and as figures of its photos."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.models import FAMILIES, camera_matrix, projection_of_model, row_of_model
from sfm_app.camera.projection import BEARING, RAY
from sfm_app.camera.rows import FISHEYE, K1, PERSPECTIVE
from sfm_app.colmap.backend import Camera, Reconstruction, pycolmap, run_in_daemon_thread, translate_errors
from sfm_app.colmap.database import open_database
from sfm_app.geometry.epipolar import TwoViewSeed
from sfm_app.geometry.poses import Similarity
from sfm_app.numerical import finite_entries
from sfm_app.types import CameraModel, Model, PairId, PosedPhoto, Scene, SceneArrays, Surface
from sfm_app.types.arrays import BoolArray, ByteArray, FloatArray, IndexArray


def finite_mask(xyz: FloatArray) -> BoolArray:
    """Return (...) which points (..., 3) are finite, and near enough that squares do not overflow."""
    return np.asarray((np.abs(xyz) < 1e100).all(axis=-1))


def unposed_model(database: Path, *, unconnected: bool = True) -> Reconstruction:
    """Return a database as a model without poses and points, with or without photos that no pair connects."""
    options = pycolmap.DatabaseCacheOptions()
    options.load_all_images = unconnected
    with open_database(database) as db:
        cache = pycolmap.DatabaseCache.create(db, options)
    model = Reconstruction()
    model.load(cache)
    return model


def pose_photo(model: Reconstruction, photo: int, cam_from_world: pycolmap.Rigid3d) -> None:
    """Give a photo of a model its pose, in place."""
    image = model.images[photo]
    model.frames[image.frame_id].set_cam_from_world(image.camera_id, cam_from_world)
    model.register_frame(image.frame_id)


def model_from_seed(database: Path, pair: PairId, matches: NDArray[np.uint32], seed: TwoViewSeed) -> Reconstruction:
    """Return a model of two photos with our pose and our usable points, one per row of the matches (N, 2)."""
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

    R: FloatArray
    t: FloatArray
    """(3, 3) rotation and (3,) translation, camera from world."""
    lines: FloatArray
    """(N, 9) bearing vectors of keypoints, see `camera.bearings`."""


def placed_views(model: Reconstruction, keypoints: Mapping[int, FloatArray]) -> dict[int, PlacedView]:
    """Return all photos of a model that have a pose, by id; keypoints are (N, 2) pixels."""
    views = {}
    for image in posed_images(model):
        camera, pose = model.cameras[image.camera_id], image.cam_from_world().matrix()
        lines = bearing_vectors(camera, keypoints[image.image_id])
        views[image.image_id] = PlacedView(pose[:, :3].copy(), pose[:, 3].copy(), lines)
    return views


def camera_family(camera: Camera) -> int:
    """Return the family of a camera, as in `camera.projection`."""
    return FAMILIES[projection_of_model(camera.model.name)]


def read_camera(camera: Camera) -> FloatArray:
    """Return the parameters (12,) of a camera, as in `camera.projection`."""
    return row_of_model(camera.model.name, camera.params)


def bearing_vectors(camera: Camera, x: FloatArray) -> FloatArray:
    """Return bearing vectors (N, 9) of pixels (N, 2), as `camera.bearings` does."""
    if camera_family(camera) != PERSPECTIVE:
        # step of the derivatives: curvature and rounding in double precision cost about 1e-9 of them
        step_px = 1e-3
        steps = np.vstack([x + step for step in ([0.0, 0.0], [step_px, 0.0], [0.0, step_px])])
        here, right, down = np.asarray(camera.cam_ray_from_img(steps), np.float64).reshape(3, -1, 3)
        return np.hstack([here, (right - here) / step_px, (down - here) / step_px])
    lines = np.zeros((len(x), BEARING))
    lines[:, :2], lines[:, 2] = np.asarray(camera.cam_from_img(x), np.float64).reshape(-1, 2), 1.0
    lines[:, 3], lines[:, 7] = 1.0 / camera.focal_length_x, 1.0 / camera.focal_length_y
    return lines


def posed_photo_ids(model: Reconstruction) -> list[int]:
    """Return the ids of the posed photos of a model, in order."""
    return [image.image_id for image in posed_images(model)]


def cameras_by_photo(model: Reconstruction) -> dict[int, tuple[FloatArray, tuple[float, ...]]]:
    """Return K (3, 3) and `Calibration.distortion` of every posed photo, by id: k1; of a fisheye, all radial terms."""
    return {image.image_id: _matrix_and_terms(model.cameras[image.camera_id]) for image in posed_images(model)}


def _matrix_and_terms(camera: Camera) -> tuple[FloatArray, tuple[float, ...]]:
    k1, k2, _, _, k3, k4, *_ = read_camera(camera)[K1:].tolist()
    is_fisheye = camera_family(camera) == FISHEYE
    return scale_matrix(camera), (k1, k2, 0.0, 0.0, k3, k4) if is_fisheye else (k1,)


def color_points(model: Reconstruction, photo_dir: Path, workers: int) -> None:
    """Give every point the mean color of its pixels, in place."""
    run_in_daemon_thread(lambda: model.extract_colors_for_all_images(photo_dir, num_threads=workers))


def submodel(model: Reconstruction, photos: Collection[int]) -> Reconstruction:
    """Return a copy of a model with only the given photos, and the points that at least two of them see."""
    part, members = Reconstruction(model), set(photos)
    for image in posed_images(model):
        if image.image_id not in members:
            part.deregister_frame(image.frame_id)
    part.tear_down()  # with frames that have no pose, no covariance can be estimated
    return part


def all_images(model: Reconstruction) -> Iterable[pycolmap.Image]:
    """Return all photos of a model, with and without a pose."""
    images: Iterable[pycolmap.Image] = model.images.values()  # the stubs of pycolmap 4.2 do not type them
    return images


def posed_images(model: Reconstruction) -> list[pycolmap.Image]:
    """Return the posed photos of a model, in order of ids."""
    return sorted((image for image in all_images(model) if image.has_pose), key=lambda image: image.image_id)


def poses_and_points(model: Reconstruction) -> tuple[dict[int, FloatArray], FloatArray]:
    """Return (3, 4) cam_from_world of the posed photos by id, in order of ids, and the points (P, 3)."""
    poses = {image.image_id: np.asarray(image.cam_from_world().matrix(), np.float64) for image in posed_images(model)}
    points = np.array([model.points3D[key].xyz for key in sorted(model.points3D)]).reshape(-1, 3)
    return poses, points


def finite_points(model: Reconstruction) -> list[pycolmap.Point3D]:
    """Return the finite points of a model, in order of ids."""
    return [model.points3D[key] for key in sorted(model.points3D) if finite_mask(model.points3D[key].xyz)]


def point_arrays(points: Sequence[pycolmap.Point3D]) -> tuple[FloatArray, ByteArray]:
    """Return positions (P, 3) and colors (P, 3) of points."""
    xyz = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    return xyz, np.array([point.color for point in points], np.uint8).reshape(-1, 3)


@dataclass(frozen=True, slots=True, eq=False)
class SeenPoints:
    """Points of a model, and the photos that see them."""

    points: FloatArray
    """(P, 3)"""
    colors: ByteArray
    """(P, 3)"""
    seen: tuple[IndexArray, ...]
    """For each posed photo, in order of ids, the rows of its points."""


def seen_points(model: Reconstruction, most: int) -> SeenPoints:
    """Return the finite points of a colored model, or a sample of at most `most`, drawn with a fixed seed."""
    points = finite_points(model)
    sample = [points[k] for k in np.sort(np.random.default_rng(0).permutation(len(points))[:most])]
    rows: dict[int, list[int]] = {image_id: [] for image_id in posed_photo_ids(model)}
    for row, point in enumerate(sample):
        for image_id in {element.image_id for element in point.track.elements} & rows.keys():
            rows[image_id].append(row)
    return SeenPoints(*point_arrays(sample), tuple(np.array(own, np.int64) for own in rows.values()))


def scale_matrix(camera: Camera) -> FloatArray:
    """Return K (3, 3) of a camera; of a panorama, the scale at its center."""
    return camera_matrix(*read_camera(camera)[:4].tolist())


def viewing_rays(model: Reconstruction, image_id: int, x: FloatArray) -> FloatArray:
    """Return viewing directions (N, 3), of any length, of pixels (N, 2) of a posed photo, in the frame of the world."""
    image = model.images[image_id]
    R = image.cam_from_world().matrix()[:, :3]
    return np.asarray(bearing_vectors(model.cameras[image.camera_id], np.asarray(x, np.float64))[:, RAY] @ R)


def focal_px(model: Reconstruction, image_id: int) -> float:
    """Return the focal length of the camera of a photo, in pixels."""
    return float(np.sqrt(np.prod(np.diag(scale_matrix(model.cameras[model.images[image_id].camera_id]))[:2])))


def move(model: Reconstruction, similarity: Similarity) -> None:
    """Move a model in place, by a similarity from its frame into the new one."""
    rotation = pycolmap.Rotation3d(similarity.R)
    model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.t))


def model_arrays(model: Reconstruction, *, metric: bool) -> SceneArrays:
    """Return poses, cameras, points and tracks of a model, whose unit may be the meter (`metric`)."""
    images = sorted(posed_images(model), key=lambda image: image.name)
    cameras = [model.cameras[image.camera_id] for image in images]
    points = [model.points3D[key] for key in sorted(model.points3D)]
    rows = {image.image_id: row for row, image in enumerate(images)}
    keypoints = [np.array([point.xy for point in image.points2D], np.float64).reshape(-1, 2) for image in images]
    observations = [
        (row, rows[member.image_id], member.point2D_idx)
        for row, point in enumerate(points)
        for member in point.track.elements
        if member.image_id in rows
    ]
    point, photo, keypoint = np.array(observations, np.int64).reshape(-1, 3).T
    starts = np.cumsum([0, *map(len, keypoints)])
    pixels = np.concatenate([*keypoints, np.zeros((0, 2))])[starts[photo] + keypoint]
    poses = [image.cam_from_world().matrix() for image in images]
    xyz, colors = point_arrays(points)
    return SceneArrays(
        photos=tuple(image.name for image in images),
        cam_from_world=np.array(poses, np.float64).reshape(-1, 3, 4),
        K=np.array([scale_matrix(camera) for camera in cameras], np.float64).reshape(-1, 3, 3),
        sizes=np.array([(camera.width, camera.height) for camera in cameras], np.int64).reshape(-1, 2),
        points=xyz,
        colors=colors,
        errors_px=np.array([point.error for point in points], np.float64),
        track_points=point,
        track_photos=photo,
        track_pixels=pixels,
        metric=metric,
    )


# The model on disk.


def read_model(model_dir: Path, frame: Similarity | None = None) -> Reconstruction:
    """Read a model on disk, and move it by a similarity, if one is given."""
    with translate_errors("reading the sparse model"):
        model = Reconstruction(model_dir)
        if frame is not None:
            move(model, frame)
    return model


def sparse_model(model_dir: Path) -> Model:
    """Return the colored points of a model on disk, and its posed photos as frusta, in order of ids.

    No third photo confirms points that only two photos see. Wrong points among these are far away, and would shrink the
    scene to a dot in a viewer. So points outside the bounding box of the confirmed points are left out, if a hundred or
    more are confirmed.
    """
    model = read_model(model_dir)
    points = finite_points(model)
    xyz, colors = point_arrays(points)
    confirmed = np.array([point.track.length() > 2 for point in points], bool)
    if np.count_nonzero(confirmed) >= 100:
        low, high = xyz[confirmed].min(axis=0), xyz[confirmed].max(axis=0)
        inside = ((xyz >= low) & (xyz <= high)).all(axis=1)
        xyz, colors = xyz[inside], colors[inside]
    cameras = tuple(_frustum(image, model.cameras[image.camera_id]) for image in posed_images(model))
    return Model(Surface(xyz, np.zeros((0, 3), np.int64), colors), cameras=cameras)


def _frustum(image: pycolmap.Image, camera: Camera) -> PosedPhoto:
    K, pose = scale_matrix(camera), image.cam_from_world().matrix()
    if camera.is_spherical():  # drawn as a view of 90 degrees to its front
        K = camera_matrix(camera.width / 2, camera.width / 2, camera.width / 2, camera.height / 2)
    return PosedPhoto(image.name, K, np.asarray(pose, np.float64), camera.width, camera.height)


class RefinedCamera(TypedDict, total=False):
    """Facts about a refined camera that COLMAP's model does not hold; as in `CameraModel`."""

    deviations: Mapping[str, float | None]
    determined: Sequence[str]
    correlations: Mapping[str, float | None]


def read_scene(
    model_dir: Path, names: Mapping[str, str], unregistered: Mapping[str, str], refined: Mapping[str, RefinedCamera]
) -> Scene:
    """Read a model on disk as the scene of later stages; `unregistered` has the reason why a photo has no pose."""
    model = Reconstruction(model_dir)
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


def _camera(camera: Camera, refined: RefinedCamera) -> CameraModel:
    K = scale_matrix(camera)
    params = tuple(float(value) for value in camera.params)
    deviations, determined = finite_entries(refined.get("deviations", {})), tuple(refined.get("determined", ()))
    correlations = finite_entries(refined.get("correlations", {}))
    return CameraModel(camera.model.name, params, K, camera.width, camera.height, deviations, determined, correlations)


@dataclass(frozen=True, slots=True)
class PhotoObservations:
    """Observations of one photo."""

    points: int
    residual_px: float
    """Mean distance between its keypoints and the points that they observe; NaN without any."""
    coverage: float
    """Share of its 8 x 8 cells with a keypoint that observes a point."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelFigures:
    """Figures of a model."""

    photos: dict[str, PhotoObservations]
    """By name, of the posed photos."""
    tracks: IndexArray
    """(P,) number of photos that see each point."""
    places: FloatArray
    """(P, 3) the points."""


def model_figures(model_dir: Path) -> ModelFigures:
    """Return the figures of a model on disk."""
    with translate_errors("reading the sparse model"):
        model = Reconstruction(model_dir)
        xyz = {key: np.asarray(point.xyz) for key, point in model.points3D.items()}
        photos = {image.name: _observe(image, model.cameras[image.camera_id], xyz) for image in posed_images(model)}
        keys = [key for key in sorted(xyz) if finite_mask(xyz[key])]
        tracks = np.array([model.points3D[key].track.length() for key in keys], np.int64)
    return ModelFigures(photos, tracks, np.array([xyz[key] for key in keys]).reshape(-1, 3))


def _observe(image: pycolmap.Image, camera: Camera, xyz: dict[int, FloatArray]) -> PhotoObservations:
    keypoints = image.get_observation_points2D()
    if not keypoints:
        return PhotoObservations(0, float("nan"), 0.0)
    pixels = np.array([point.xy for point in keypoints], np.float64)
    pose = image.cam_from_world().matrix()
    local = np.array([xyz[point.point3D_id] for point in keypoints]) @ pose[:, :3].T + pose[:, 3]
    off = np.linalg.norm(np.asarray(camera.img_from_cam(local), np.float64) - pixels, axis=1)
    cells = np.clip(pixels / (camera.width, camera.height) * 8, 0, 7).astype(np.int64)
    coverage = len(np.unique(cells, axis=0)) / 8**2
    return PhotoObservations(len(keypoints), float(np.nanmean(off)), coverage)
