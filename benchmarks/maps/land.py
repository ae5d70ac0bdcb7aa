"""Fields on hills with houses and trees, and a drone that photographs them from above."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.maps.truth import ORIGIN
from benchmarks.synthetic.houses import BRIGHT, WALLS, draw_material
from benchmarks.synthetic.town import GRAYS, GREENS
from sfm_app.synthetic.cameras import Camera, Views, axis_rotation
from sfm_app.synthetic.render import cast_rays, ray_caster
from sfm_app.synthetic.shapes import Body, Color, Pattern, Shape, SyntheticScene, ball, box, grid
from sfm_app.types.scene import camera_center

FloatArray = NDArray[np.float64]
Random = np.random.Generator

BEARING_DEG = 25.0
"""Direction of the flight lines, clockwise from north: nothing lies along the axes of the map."""
SYSTEM = "EPSG:32632"
APART_M = 13.0
"""Least distance between the middles of two houses."""
CROPS: tuple[Pattern, ...] = ("leaves", "paving", "stone", "leaves")
SOILS: tuple[Color, ...] = ((120, 92, 64), (150, 124, 90), *GREENS)


def hills(x: FloatArray, z: FloatArray) -> FloatArray:
    """Return heights of the ground in meters."""
    return np.asarray(1.6 * np.sin(x / 9.0 + 0.4) * np.cos(z / 11.0) + 0.9 * np.sin((x + z) / 5.5) + 0.04 * x)


def land(side: float, seed: int) -> SyntheticScene:
    """Return a square of land around (0, 0); x is east and z south."""
    rng = np.random.default_rng([seed, 58])
    edges = np.linspace(-side / 2.0, side / 2.0, 6)
    bodies = []
    for k in range(25):
        x, z = edges[k // 5 : k // 5 + 2], edges[k % 5 : k % 5 + 2]
        colors = (SOILS, GRAYS)[int(rng.integers(2))]
        material = draw_material(CROPS[int(rng.integers(4))], colors, float(rng.uniform(0.3, 0.9)), rng)
        bodies.append(Body(_ground(x, z), material))
    places = list[FloatArray]()
    for _ in range(int((side / 8.0) ** 2)):
        place = rng.uniform(-0.4 * side, 0.4 * side, 2)
        if all(np.linalg.norm(place - other) > APART_M for other in places):
            places.append(place)
            bodies += _house((place[0], float(hills(*place)), place[1]), rng)
    for _ in range(int((side / 12.0) ** 2)):
        x, z = rng.uniform(-0.45 * side, 0.45 * side, 2).tolist()
        crown = ball(float(rng.uniform(0.6, 1.4)), segments=24, bumps=0.15, seed=int(rng.integers(1000)))
        at = (x, float(hills(np.array(x), np.array(z))) + 0.5, z)
        bodies.append(Body(crown.move(at), draw_material("leaves", GREENS, 0.15, rng)))
    return SyntheticScene("land", tuple(bodies), to_light=(0.45, 0.9, 0.35))


def _ground(x: FloatArray, z: FloatArray) -> Shape:
    """Return a field; its normals are those of the hills, so that shades continue across its borders."""
    points, faces = grid(np.linspace(z[0], z[1], 40), np.linspace(x[0], x[1], 40))
    u, v, step = points[:, 1], points[:, 0], 1e-4
    slopes = (hills(u + step, v) - hills(u, v)) / step, (hills(u, v + step) - hills(u, v)) / step
    normals = np.column_stack([-slopes[0], np.ones(len(u)), -slopes[1]])
    vertices = np.column_stack([u, hills(u, v), v])
    return Shape(vertices, faces, normals / np.linalg.norm(normals, axis=1, keepdims=True), vertices)


def _house(at: tuple[float, float, float], rng: Random) -> list[Body]:
    """Return a house with a flat roof, or with two slabs as a roof that juts out."""
    turn = float(rng.uniform(0.0, 180.0))
    width, tall, deep = rng.uniform((5.0, 3.0, 4.0), (8.0, 6.0, 6.0)).tolist()
    foot = (at[0], at[1] - 1.5, at[2])
    walls = box(width, tall + 1.5, deep, spacing=1.0).move(foot, turn)
    bodies = [Body(walls, draw_material("masonry", WALLS, 0.3, rng))]
    if rng.uniform() < 0.4:
        return bodies
    roof = draw_material("paving", (*BRIGHT, (150, 70, 50)), 0.35, rng)
    slope, lean = 0.5 * deep / np.cos(np.radians(30.0)) + 0.4, 30.0
    turned = axis_rotation(np.array([0.0, 1.0, 0.0]), turn)
    for sign in (-1.0, 1.0):
        slab = box(width + 0.6, 0.15, slope, spacing=1.0).move(turn_deg=turn, tilt_deg=sign * lean)
        aside = 0.5 * slope * np.cos(np.radians(lean))
        shift = turned @ np.array([0.0, 0.5 * deep * np.tan(np.radians(lean)) - 0.5 * slope * 0.5, sign * aside])
        bodies.append(Body(slab.move((at[0] + shift[0], at[1] + tall + shift[1], at[2] + shift[2])), roof))
    return bodies


def flight(camera: Camera, side: float, height: float, overlap: tuple[float, float], seed: int) -> Views:
    """Return photos from above along parallel lines over a square, at a height over its middle.

    `overlap` is the share along the path and across. The drone leans by 2 degrees, and turns at the end of each line.
    """
    rng = np.random.default_rng([seed, 59])
    reach = height / camera.K[0, 0] * np.array([camera.height, camera.width])
    along, across = (np.arange(-side / 2.0, side / 2.0 + 1e-6, step) for step in reach * (1.0 - np.array(overlap)))
    turn = axis_rotation(np.array([0.0, 1.0, 0.0]), -BEARING_DEG)
    poses = []
    for line, x in enumerate(across - across.mean()):
        back = -1.0 if line % 2 else 1.0
        for z in (along - along.mean()) * back:
            lean = axis_rotation(np.array([1.0, 0.0, 0.0]), float(rng.normal(scale=2.0)))
            lean = lean @ axis_rotation(np.array([0.0, 1.0, 0.0]), float(rng.normal(scale=2.0)))
            yaw = axis_rotation(np.array([0.0, 0.0, 1.0]), float(rng.normal(scale=3.0)))
            R = lean @ yaw @ np.diag([back, back, 1.0]) @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) @ turn.T
            center = turn @ (np.array([x, height, z]) + rng.normal(scale=0.3, size=3))
            poses.append(np.column_stack([R, -R @ center]))
    return Views.from_poses(camera, poses)


def write_positions(file: Path, views: Views, noise_m: float, seed: int) -> None:
    """Write positions of the photos with noise in each direction, as OpenDroneMap's geo.txt."""
    rng = np.random.default_rng([seed, 60])
    lines = [SYSTEM]
    for name, pose in views.cam_from_world.items():
        east, north, up = on_map(camera_center(pose)[None])[0] + rng.normal(scale=noise_m, size=3)
        lines.append(f"{name} {east:.4f} {north:.4f} {up:.4f} 0 0 0 {noise_m:g} {noise_m:g}")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_control_points(file: Path, scene: SyntheticScene, views: Views, side: float, seed: int) -> None:
    """Write eight points and four that check, on the ground, marked in all photos that see them, half a pixel off."""
    rng, surface = np.random.default_rng([seed, 61]), ray_caster(scene.vertices, scene.faces)
    angle = np.pi / 4.0 * np.arange(12)
    rings = np.array([0.38, 0.19] * 4 + [0.3] * 4)
    angle[8:] = np.pi / 8.0 + np.pi / 2.0 * np.arange(4)
    places = side * rings[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    lines = [SYSTEM]
    for number, (x, z) in enumerate(places):
        role = "point" if number < 8 else "CHK-"
        fall = cast_rays(surface, np.array([x, 100.0, z]), np.array([[0.0, -1.0, 0.0]]))["t_hit"]
        point = np.array([x, 100.0 - float(fall[0]), z])
        east, north, up = on_map(point[None])[0]
        for name, pose in views.cam_from_world.items():
            camera, center = views.cameras[name], camera_center(pose)
            pixel = camera.K @ (pose[:, :3] @ point + pose[:, 3])
            u, v = pixel[:2] / pixel[2]
            hidden = cast_rays(surface, center, (point - center)[None])["t_hit"][0] < 0.999
            if 20.0 < u < camera.width - 20.0 and 20.0 < v < camera.height - 20.0 and not hidden:
                u, v = np.array([u, v]) + rng.normal(scale=0.5, size=2)
                lines.append(f"{east:.4f} {north:.4f} {up:.4f} {u:.2f} {v:.2f} {name} {role}{number}")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def on_map(points: FloatArray) -> FloatArray:
    """Return points (N, 3) of the scene as east, north and height on the map."""
    x, y, z = points.T
    return np.asarray(np.column_stack([x, -z, y]) + ORIGIN)
