"""Synthetic models as mapping leaves them, with known lenses: noisy keypoints, wrong ones among them, and no photos."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.models import camera_matrix
from sfm_app.colmap.backend import log_level, pycolmap, show_log
from sfm_app.synthetic.cameras import ArcOptions, Camera, Lens, Views, arc, make_wide_camera

FloatArray = NDArray[np.float64]

SIZE = (1200, 800)
NOISE_PX = (0.3, 0.5)
"""Range of the noise of a coordinate."""
PHOTOS = (12, 20)
POINTS = 1500
DEPTHS = (2.0, 8.0)
"""Range of the distance of points to one of the photos, where the photos are 4.6 to 6.6 from the middle."""
SEEN_SHARE = 0.6
"""Share of the photos that show a point in which it is found."""
WRONG_SHARE, WRONG_PX = 0.05, 3.0
"""Share of keypoints that are off by more than noise, and the scale of that (Laplace)."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """A synthetic bundle before it is a model of COLMAP."""

    camera: Camera
    views: Views
    X: FloatArray
    """(P, 3) points."""
    seen: dict[int, NDArray[np.int64]]
    """By photo, from 1 on: the points that it shows."""
    x: dict[int, FloatArray]
    """By photo: (N, 2) where they were found."""


def draw_bundle(camera: Camera, rng: np.random.Generator, *, near: float = 1.0) -> Drawn:
    """Draw photos of points all around.

    Args:
        camera: of all photos.
        rng: source of everything random.
        near: share of the usual distance to the scene.
    """
    photos = int(rng.integers(PHOTOS[0], PHOTOS[1] + 1))
    options = ArcOptions(photos=photos, sweep_deg=100.0, distance=(4.6 * near, 6.6 * near))
    views = arc(camera, options, int(rng.integers(1 << 30)))
    X = _draw_points(camera, list(views.cam_from_world.values()), rng)
    noise = rng.uniform(*NOISE_PX)
    seen, x = {}, {}
    for number, pose in enumerate(views.cam_from_world.values(), start=1):
        points = X @ pose[:, :3].T + pose[:, 3]
        shown = np.flatnonzero(points[:, 2] > 0.05)
        found = camera.lens.project(points[shown]) * np.diag(camera.K)[:2] + camera.K[:2, 2]
        inside = np.all((found > 0.0) & (found < [camera.width, camera.height]), axis=1)
        inside &= unfolded(camera, points[shown]) & (rng.random(len(shown)) < SEEN_SHARE)
        wrong = rng.random(inside.sum()) < WRONG_SHARE
        off = rng.normal(scale=noise, size=(inside.sum(), 2))
        off[wrong] += rng.laplace(scale=WRONG_PX, size=(wrong.sum(), 2))
        seen[number], x[number] = shown[inside], found[inside] + off
    return Drawn(camera, views, X, seen, x)


def _draw_points(camera: Camera, poses: list[FloatArray], rng: np.random.Generator) -> FloatArray:
    """Return points (P, 3), each on the ray of a random pixel of a random photo, at a depth like that of the scene."""
    pixels = rng.uniform([0.0, 0.0], [camera.width, camera.height], (POINTS, 2))
    rays = camera.lens.rays((pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2])
    # a fisheye may show nothing in the corners
    shown = np.isfinite(rays).all(axis=1, keepdims=True) & (rays[:, 2:] > 0.05)
    rays = np.where(shown, rays, [0.0, 0.0, 1.0])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    depths = rng.uniform(*DEPTHS, POINTS)
    from_photo = [poses[k] for k in rng.integers(len(poses), size=POINTS)]
    return np.array(
        [pose[:, :3].T @ (depth * ray - pose[:, 3]) for pose, depth, ray in zip(from_photo, depths, rays, strict=True)]
    )


def unfolded(camera: Camera, points: FloatArray) -> NDArray[np.bool_]:
    """Return (N,) which points (N, 3) a lens shows before its radius folds."""
    if camera.lens.projection != "perspective" or not camera.lens.radial:
        return np.ones(len(points), np.bool_)
    r2 = np.sum(points[:, :2] ** 2, axis=1) / points[:, 2] ** 2
    r = np.linspace(0.0, np.sqrt(r2.max(initial=0.0)), 2000)
    radius = r * (1.0 + sum(k * r ** (2 * power) for power, k in enumerate(camera.lens.radial, start=1)))
    falls = np.flatnonzero(np.diff(radius) <= 0.0)
    return np.asarray(r2 < (r[falls[0]] ** 2 if len(falls) else np.inf), np.bool_)


def write_model(drawn: Drawn, start: pycolmap.Camera, database: Path) -> pycolmap.Reconstruction:
    """Write the database and return the model with true poses and points, and a given camera.

    Args:
        drawn: the bundle.
        start: camera that mapping starts from.
        database: new file.
    """
    with pycolmap.Database.open(database) as db:
        camera_id = db.write_camera(start)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
        db.write_rig(rig)
        for number, name in enumerate(drawn.views.cam_from_world, start=1):
            db.write_image(pycolmap.Image(name=name, camera_id=camera_id, image_id=number), use_image_id=True)
            frame = pycolmap.Frame(frame_id=number, rig_id=1)
            frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id), number))
            db.write_frame(frame, use_frame_id=True)
            db.write_keypoints(number, np.asarray(drawn.x[number], np.float32))
        for a in drawn.seen:
            for b in range(a + 1, len(drawn.seen) + 1):
                _, i, j = np.intersect1d(drawn.seen[a], drawn.seen[b], return_indices=True)
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.inlier_matches = np.column_stack([i, j]).astype(np.uint32)
                db.write_two_view_geometry(a, b, geometry)
        cache = pycolmap.DatabaseCache.create(db, pycolmap.DatabaseCacheOptions())
    model = pycolmap.Reconstruction()
    model.load(cache)
    for number, pose in enumerate(drawn.views.cam_from_world.values(), start=1):
        frame = model.frames[model.images[number].frame_id]
        frame.set_cam_from_world(camera_id, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
        model.register_frame(frame.frame_id)
    for point, xyz in enumerate(drawn.X):
        track = pycolmap.Track()
        for number, shown in drawn.seen.items():
            place = np.searchsorted(shown, point)
            if place < len(shown) and shown[place] == point:
                track.add_element(number, int(place))
        if track.length() >= 3:
            model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    return model


def adjust_like_mapping(model: pycolmap.Reconstruction, *, lens: bool) -> None:
    """Adjust a model in place as mapping does: one focal and the lens of its camera, or with the lens held.

    Args:
        model: COLMAP's reconstruction.
        lens: whether focal and lens are refined.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary, options.refine_principal_point = False, False
    options.refine_focal_length = options.refine_extra_params = lens
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.max_num_iterations = 30
    options.ceres.solver_options.function_tolerance = 1e-5
    options.ceres.solver_options.num_threads = 1
    loud = log_level()
    pycolmap.bundle_adjustment(model, options)
    show_log(loud)  # COLMAP's function sets it to everything


def perspective_bundle(
    radial: tuple[float, ...], tangential: tuple[float, float], rng: np.random.Generator, focal: float
) -> Drawn:
    """Draw photos through a perspective lens that does not fold inside the photo.

    Args:
        radial, tangential: as in `Lens`.
        rng: source of everything random.
        focal: in pixels; made longer where the lens would fold.
    """
    lens = Lens(radial=radial, tangential=tangential)
    center = np.array(SIZE) * (0.5 + rng.normal(scale=0.008, size=2))
    while True:
        camera = Camera(camera_matrix(focal, focal, *center), *SIZE, lens)
        if unfolded_to_corner(camera):
            return draw_bundle(camera, rng)
        focal *= 1.1


def unfolded_to_corner(camera: Camera) -> bool:
    """Return whether the radius of a perspective lens grows up to a little beyond the corner."""
    reach = 1.1 * np.hypot(camera.width, camera.height) / (2.0 * camera.K[0, 0])
    r = np.linspace(0.0, 4.0 * reach, 4000)
    radius = r * (1.0 + sum(k * r ** (2 * power) for power, k in enumerate(camera.lens.radial, start=1)))
    falls = np.flatnonzero(np.diff(radius) <= 0.0)
    return bool(float(radius[falls[0]] if len(falls) else radius[-1]) > reach)


def fisheye_bundle(projection: str, field_deg: float, rng: np.random.Generator) -> Drawn:
    """Draw photos through a fisheye.

    Args:
        projection, field_deg: as in `make_wide_camera`.
        rng: source of everything random.
    """
    camera = make_wide_camera(*SIZE, field_deg, Lens(projection), tuple(0.5 + rng.normal(scale=0.008, size=2)))
    return draw_bundle(camera, rng, near=max(0.5, 60.0 / field_deg))


def simple_radial(drawn: Drawn, rng: np.random.Generator) -> pycolmap.Camera:
    """Return the camera that mapping starts a perspective bundle from: focal a percent off, center in the middle.

    Args:
        drawn: the bundle.
        rng: source of the error.
    """
    true = drawn.camera
    params = [true.K[0, 0] * np.exp(rng.normal(scale=0.01)), SIZE[0] / 2, SIZE[1] / 2, true.radial]
    return new_camera("SIMPLE_RADIAL", params)


def fitted_fisheye(drawn: Drawn, rng: np.random.Generator) -> pycolmap.Camera:
    """Return the camera that mapping starts a fisheye bundle from: OPENCV_FISHEYE, its radius off by up to 0.1 %.

    Args:
        drawn: the bundle.
        rng: source of the error.
    """
    true = drawn.camera
    theta = np.linspace(0.0, np.radians(88.0), 200)[1:]
    radius = true.lens.project(np.column_stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)]))[:, 0]
    found = np.linalg.lstsq(theta[:, None] ** [1, 3, 5, 7, 9], radius, rcond=None)[0]
    bent = found * (1.0 + rng.normal(scale=0.001, size=len(found)))
    focal = true.K[0, 0] * bent[0]
    return new_camera(
        "OPENCV_FISHEYE", [focal, focal, *true.K[:2, 2] + rng.normal(scale=2.0, size=2), *bent[1:] / bent[0]]
    )


def new_camera(model: str, params: list[float]) -> pycolmap.Camera:
    """Return COLMAP's camera of the photos.

    Args:
        model, params: COLMAP's model and its parameters.
    """
    kind = pycolmap.CameraModelId.__members__[model]
    return pycolmap.Camera(camera_id=1, model=kind, width=SIZE[0], height=SIZE[1], params=[float(p) for p in params])
