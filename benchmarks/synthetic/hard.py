"""Folders like those on which the program failed: equal boxes, many cameras, a palace, brass, darkness and haze."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from benchmarks.synthetic.detail_scenes import ornament, ornament_views
from benchmarks.synthetic.houses import assemble
from benchmarks.synthetic.trouble import PhotoDefects, TroubledFolder, mixed_cameras, with_distortion
from sfm_app.synthetic import scenes
from sfm_app.synthetic.cameras import ArcOptions, Camera, Views, arc, look_at, make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions
from sfm_app.synthetic.shapes import Body, Material, Shape, SyntheticScene, arch, ball, box, ground, revolve

OPTIONS = PhotoOptions(supersampling=1, quality=85, exposure_ev=0.4)
SIZES = ((800, 600), (640, 480), (800, 533), (600, 800), (720, 405), (1024, 683), (640, 640))


def statue_by_many() -> TroubledFolder:
    """Return 130 photos of the statue by 36 cameras of one size."""
    views = scenes.statue_views(make_camera(800, 600, focal_widths=1.2), seed=5, photos=130)
    return _folder("36 cameras", scenes.statue(), mixed_cameras(views, 36, 0.45, np.random.default_rng(56)))


def equal_boxes() -> TroubledFolder:
    """Return 25 photos of four boxes with equal fronts."""
    places = [((-1.1, 0.0, 0.2), 12.0), ((0.5, 0.0, 0.0), -18.0), ((1.5, 0.0, -0.9), 35.0), ((-0.4, 0.0, -1.3), -5.0)]

    def copies(shape: Shape) -> Shape:
        return assemble([shape.move(at, turn_deg=turn) for at, turn in places], keep_texture=True)

    fronts = [
        Body(copies(box(1.0, 1.5, 0.02, spacing=0.1).move((0.0, 0.0, 0.16))), replace(scenes.PAINT, scale=0.12)),
        Body(copies(box(0.5, 0.4, 0.03, spacing=0.1).move((0.1, 0.8, 0.17))), replace(scenes.MARBLE, scale=0.12)),
        Body(copies(box(0.7, 0.3, 0.03, spacing=0.1).move((-0.05, 0.2, 0.17))), replace(scenes.POTTERY, scale=0.06)),
    ]
    sides = [
        Body(box(1.0, 1.5, 0.3, spacing=0.1).move(at, turn_deg=turn), material)
        for (at, turn), material in zip(
            places, (scenes.WOOD, scenes.TERRACOTTA, scenes.GREEN_MARBLE, scenes.SANDSTONE), strict=True
        )
    ]
    table = Body(ground((-3.0, 3.0), (-3.0, 3.0), 0.005), replace(scenes.WOOD, scale=0.5, contrast=0.15))
    walk = ArcOptions(
        photos=25, sweep_deg=150.0, distance=(4.6, 6.2), height=(1.0, 2.2), aim=(0.2, 0.7, -0.4), aim_spread=0.3,
        roll_deg=4.0,
    )  # fmt: skip
    camera = with_distortion(make_camera(800, 600, focal_widths=1.5), -0.01)
    scene = SyntheticScene("boxes", (*fronts, *sides, table), to_light=(0.5, 0.75, 0.42))
    return _folder("equal fronts", scene, arc(camera, walk, 3))


def palace() -> TroubledFolder:
    """Return 60 photos, a camera each and seven sizes, of a palace with four equal sides; only its garden differs."""
    rng, names = np.random.default_rng(60), [f"web{k:03d}.jpg" for k in range(60)]
    cameras = {name: _web_camera(rng) for name in names}
    poses = {}
    for name, camera in cameras.items():
        turn = math.radians(rng.normal(0.0, 28.0) if rng.uniform() < 0.55 else rng.uniform(-180.0, 180.0))
        far = max(6.5 * camera.K[0, 0] / max(camera.width, camera.height) * rng.uniform(0.9, 1.3), 7.0)
        center = np.array([far * math.sin(turn), rng.uniform(0.8, 2.2), far * math.cos(turn)])
        aim = np.array([rng.normal(0.0, 0.4), rng.uniform(1.2, 2.2), rng.normal(0.0, 0.4)])
        poses[name] = look_at(center, aim, float(rng.normal(0.0, 1.5)))
    scene = SyntheticScene("palace", (*_palace(), *_garden(rng)), to_light=(0.5, 0.75, 0.42), sky=0.6)
    return _folder("equal sides, a camera each", scene, Views(cameras, poses))


def _web_camera(rng: np.random.Generator) -> Camera:
    """Draw the camera of a photo of the web: any focal, some lens, one in four cropped."""
    width, height = SIZES[int(rng.integers(len(SIZES)))]
    focal = math.exp(rng.uniform(math.log(0.9), math.log(1.8))) * max(width, height) / width
    center = 0.5 + rng.normal(0.0, 0.01, 2) + (rng.uniform(-0.08, 0.08, 2) if rng.uniform() < 0.25 else 0.0)
    return with_distortion(make_camera(width, height, focal, (center[0], center[1])), float(rng.normal(0.0, 0.02)))


def _palace() -> list[Body]:
    column = [[0.0, 0.0], [0.2, 0.0], [0.16, 0.2], [0.16, 3.0], [0.24, 3.1], [0.24, 3.3], [0.0, 3.5]]
    wall = [box(4.0, 2.2, 0.3).move((0.0, 0.3, 1.85))]
    trim = [box(4.1, 0.15, 0.2).move((0.0, 2.35, 2.02)), box(4.3, 0.3, 0.5).move((0.0, 0.0, 1.95))]
    posts = [revolve(np.array(column), segments=32).move((2.3, 0.0, 2.3))]
    for x in (-1.4, 0.0, 1.4):
        trim.append(arch(0.42 if x else 0.55, 0.12, 0.2).move((x, 1.3, 2.02)))
        posts += [box(0.14, 1.1, 0.16).move((x + aside, 0.3, 2.05)) for aside in (-0.55, 0.55)]
    dome = np.array([[1.2, 0.0], [1.3, 0.4], [1.2, 0.9], [0.8, 1.4], [0.1, 1.7], [0.0, 2.0]])
    return [
        Body(assemble([part.move(turn_deg=90.0 * k) for k in range(4) for part in parts], keep_texture=True), material)
        for parts, material in ((wall, scenes.BRICK), (trim, scenes.SANDSTONE), (posts, scenes.LIMESTONE))
    ] + [
        Body(revolve(dome, segments=64).move((0.0, 2.5, 0.0)), replace(scenes.MARBLE, scale=0.25)),
        Body(box(3.8, 0.2, 3.8).move((0.0, 2.4, 0.0)), scenes.SANDSTONE),
    ]


def _garden(rng: np.random.Generator) -> list[Body]:
    bodies = [Body(ground((-9.0, 9.0), (-9.0, 9.0), 0.02, spacing=0.2), scenes.PAVING)]
    for k in range(14):
        turn, far = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(4.2, 6.0)
        bush = ball(float(rng.uniform(0.2, 0.4)), bumps=0.1, seed=k)
        place = (far * math.cos(turn), 0.3, far * math.sin(turn))
        bodies.append(Body(bush.move(place), replace(scenes.LEAVES, scale=0.055 * float(rng.uniform(0.7, 1.4)))))
    return bodies


def brass() -> TroubledFolder:
    """Return 23 photos, close up, of a miniature of brushed brass on white paper."""
    yellow, white = (196, 156, 82), (236, 236, 232)
    metal = Material(
        pattern="stone", base=yellow, second=(168, 124, 58), joint=yellow, scale=0.05, contrast=0.12, shine=0.75
    )  # fmt: skip
    foot = np.array(
        [[0.0, 0.0], [0.3, 0.0], [0.3, 0.05], [0.12, 0.1], [0.08, 0.3], [0.2, 0.42], [0.22, 0.5], [0.0, 0.5]]
    )
    parts = [
        revolve(foot, segments=96),
        box(0.5, 0.08, 0.26, spacing=0.02).move((0.0, 0.5, 0.0)),
        box(0.3, 0.16, 0.2, spacing=0.02).move((-0.08, 0.58, 0.0), turn_deg=8.0),
        ball(0.12, bumps=0.12, seed=5).move((0.12, 0.66, 0.02)),
        arch(0.1, 0.03, 0.06).move((0.0, 0.1, 0.2)),
    ]
    paper = Material(pattern="stone", base=white, second=(228, 228, 224), joint=white, scale=0.4, contrast=0.02)
    scene = SyntheticScene(
        "brass", (Body(assemble(parts), metal), Body(ground((-4.0, 4.0), (-4.0, 4.0), 0.0), paper)),
        to_light=(0.4, 0.8, 0.45), sky=0.6, sun=0.6,
    )  # fmt: skip
    walk = ArcOptions(
        photos=23, sweep_deg=300.0, distance=(1.6, 2.0), height=(0.7, 1.4), aim=(0.0, 0.37, 0.0), aim_spread=0.05,
        roll_deg=5.0,
    )  # fmt: skip
    return _folder("brushed metal", scene, arc(make_camera(900, 675, focal_widths=1.6), walk, 11))


def dark() -> TroubledFolder:
    """Return the ornament at 8 % of its brightness."""
    return _ornament("darkness", (0.08, 0.0))


def haze() -> TroubledFolder:
    """Return the ornament in haze that leaves 8 % of its contrast."""
    return _ornament("haze", (0.08, 170.0))


def _ornament(trouble: str, grays: tuple[float, float]) -> TroubledFolder:
    views = ornament_views(make_camera(1200, 900, focal_widths=1.5))
    return replace(_folder(trouble, ornament(), views), spoiling=PhotoDefects(grays=grays))


def _folder(trouble: str, scene: SyntheticScene, views: Views) -> TroubledFolder:
    return TroubledFolder(troubles=(trouble,), scene=scene, views=views, options=OPTIONS)


HARD: Mapping[str, Callable[[], TroubledFolder]] = {
    "statue-by-many": statue_by_many,
    "equal-boxes": equal_boxes,
    "palace": palace,
    "brass": brass,
    "dark": dark,
    "haze": haze,
}
