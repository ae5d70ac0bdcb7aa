"""A scene with two printed markers in it, and ground control points as somebody marks them."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.synthetic.scenes import marker_sheet
from sfm_app.frame.coordinates import LocalFrame, read_system
from sfm_app.frame.markers import draw_pattern
from sfm_app.synthetic.cameras import Views
from sfm_app.synthetic.shapes import SyntheticScene
from sfm_app.types.scene import camera_center

FloatArray = NDArray[np.float64]

FAMILY = "apriltag-36h11"
UTM = np.array([500_000.0, 4_649_000.0, 320.0])
"""East, north and up of the scene's origin."""
GROUND = LocalFrame(read_system("EPSG:32632"), UTM)
"""Meters east, north and up of it on the ground."""
MARK_PX = 0.5
"""Standard deviation of a mark in a photo."""
SURVEY_M = 0.002
"""Standard deviation of the coordinates of a point, in scene units."""
WRONG_M = 0.05
"""By how much a wrong point is off, as a share of the distance to the scene."""


def add_markers(scene: SyntheticScene, views: Views, side: float) -> SyntheticScene:
    """Return a scene with two markers that stand before what the middle photo shows, and face it.

    Args:
        scene: what is photographed.
        views: of the photos.
        side: of a marker, in scene units.
    """
    center, aim = center_and_aim(scene.vertices, views)
    along = aim - center
    right = np.cross(along, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    turn = float(np.degrees(np.arctan2(-along[0], -along[2])))
    bodies = list(scene.bodies)
    for number, aside in enumerate((-0.16, 0.16)):
        at = center + 0.75 * along + aside * np.linalg.norm(along) * right
        x, y, z = map(float, at)
        bodies += marker_sheet(draw_pattern(FAMILY, number), side, (x, y, z), turn - 60 * aside, 82.0)
    return replace(scene, bodies=tuple(bodies))


def center_and_aim(vertices: FloatArray, views: Views) -> tuple[FloatArray, FloatArray]:
    """Return where the middle photo was taken from, and the place on its axis at the depth of what it shows.

    Args:
        vertices: (V, 3) of the scene.
        views: of the photos.
    """
    name = sorted(views.cam_from_world)[len(views.cam_from_world) // 2]
    pose = views.cam_from_world[name]
    shown = np.isfinite(project(vertices, views, name)).all(axis=1)
    depth = float(np.median(vertices[shown] @ pose[2, :3] + pose[2, 3]))
    center = camera_center(pose)
    return center, center + depth * pose[2, :3]


def write_control_points(
    path: Path, vertices: FloatArray, views: Views, count: int, wrong: Collection[int], rng: np.random.Generator
) -> None:
    """Write a file of ground control points with marks in the photos, as a hand makes them.

    Args:
        path: of the file.
        vertices: (V, 3) of the scene, from which points are taken.
        views: of the photos.
        count: how many points.
        wrong: which of them are off.
        rng: draws the points and the errors.
    """
    seen = {name: project(vertices, views, name) for name in views.cam_from_world}
    inside = np.sum([np.isfinite(x).all(axis=1) for x in seen.values()], axis=0)
    likely = np.flatnonzero(inside >= 0.7 * len(seen))
    chosen = spread_out(vertices, likely, count, rng)
    center, aim = center_and_aim(vertices, views)
    lines = ["EPSG:32632"]
    for number, vertex in enumerate(chosen):
        at = vertices[vertex] + SURVEY_M * rng.normal(size=3)
        if number in wrong:
            step = rng.normal(size=3)
            at = at + WRONG_M * np.linalg.norm(aim - center) * step / np.linalg.norm(step)
        east, north, up = GROUND.positions(np.array([[at[0], -at[2], at[1]]]))[0]
        for name, x in seen.items():
            if np.isfinite(x[vertex]).all():
                u, v = x[vertex] + MARK_PX * rng.normal(size=2)
                lines.append(f"{east:.4f} {north:.4f} {up:.4f} {u:.2f} {v:.2f} {name} p{number}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def project(points: FloatArray, views: Views, name: str) -> FloatArray:
    """Return (N, 2) where a photo shows points (N, 3), as if nothing stood in the way; NaN outside of it.

    Args:
        points: in the scene.
        views: of the photos, without distortion.
        name: of the photo.
    """
    camera, pose = views.cameras[name], views.cam_from_world[name]
    seen = (points @ pose[:, :3].T + pose[:, 3]) @ camera.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        x = seen[:, :2] / seen[:, 2:]
    outside = (seen[:, 2] <= 0) | (x < 0).any(axis=1) | (x > [camera.width, camera.height]).any(axis=1)
    x[outside] = np.nan
    return x


def spread_out(points: FloatArray, among: NDArray[np.intp], count: int, rng: np.random.Generator) -> list[int]:
    """Return indices of points far from each other: each next one is the farthest of a sample from those before it.

    Args:
        points: (N, 3).
        among: indices of those that may be chosen.
        count: how many.
        rng: draws the sample.
    """
    sample = rng.choice(among, min(200, len(among)), replace=False)
    chosen = [int(sample[0])]
    while len(chosen) < count:
        away = np.linalg.norm(points[sample][:, None] - points[chosen][None], axis=2).min(axis=1)
        chosen.append(int(sample[np.argmax(away)]))
    return chosen
