"""Photo folders with random problems of real photography, with ground truth.

The seed determines everything: the scene, the walk, the cameras, and a few problems at a time.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.synthetic.houses import assemble
from benchmarks.synthetic.walks import orbit
from sfm_app.errors import InputError
from sfm_app.synthetic.cameras import (
    ArcOptions,
    Camera,
    Lens,
    Views,
    arc,
    axis_rotation,
    look_at,
    make_camera,
    pixel_rays,
)
from sfm_app.synthetic.photo_folder import PhotoOptions, Truth, develop
from sfm_app.synthetic.render import PreparedScene, cast_rays, prepare, render_scene
from sfm_app.synthetic.scenes import (
    BRICK,
    GREEN_MARBLE,
    LEAVES,
    LIMESTONE,
    MARBLE,
    PAINT,
    PAVING,
    PLASTER,
    SANDSTONE,
    TERRACOTTA,
    WOOD,
)
from sfm_app.synthetic.shapes import Body, Material, Shape, SyntheticScene, ball, box, ground, revolve, torus
from sfm_app.types.scene import camera_center

Random = np.random.Generator
FloatArray = NDArray[np.float64]

THING_MATERIALS = (WOOD, MARBLE, PAINT, TERRACOTTA, GREEN_MARBLE, LEAVES, LIMESTONE, BRICK)
GROUND_MATERIALS = (PAVING, LEAVES, SANDSTONE)
WALL_MATERIALS = (MARBLE, GREEN_MARBLE, PLASTER, SANDSTONE, BRICK)
REPEAT_X = 1.7
"""Identical objects stand at this distance to the left and right."""


def heap_of_things(rng: Random) -> tuple[Body, ...]:
    """Return boxes, balls, rings and drums about the origin, on a ground; half of the scenes have a wall behind."""
    floor = Body(
        ground((-4.5, 4.5), (-3.5, 5.5), float(rng.uniform(0.0, 0.08)), spacing=0.15),
        _draw_material(GROUND_MATERIALS, rng),
    )
    bodies = [floor]
    for _ in range(int(rng.integers(7, 19))):
        x, z = rng.uniform((-2.2, -1.8), (2.2, 1.2))
        bodies.append(
            Body(
                _random_thing(rng).move((x, 0.0, z), turn_deg=rng.uniform(0.0, 360.0)),
                _draw_material(THING_MATERIALS, rng),
            )
        )
    if rng.uniform() < 0.5:
        bodies.append(
            Body(
                box(9.0, 3.2, 0.2).move((0.0, -0.1, float(rng.uniform(-3.2, -2.2)))),
                _draw_material(WALL_MATERIALS, rng),
            )
        )
    return tuple(bodies)


def repeated_things(rng: Random) -> tuple[Body, ...]:
    """Return two or three objects, each in two places with identical texture."""
    bodies = []
    for k in range(int(rng.integers(2, 4))):
        thing = _random_thing(rng, size=(0.6, 1.0)).move(
            (0.5 * (k - 1), 0.0, 0.5 * (k % 2)), turn_deg=rng.uniform(0.0, 90.0)
        )
        copies = [thing.move((side * REPEAT_X, 0.0, 1.0)) for side in (-1.0, 1.0)]
        bodies.append(Body(assemble(copies, keep_texture=True), _draw_material(THING_MATERIALS, rng)))
    return tuple(bodies)


def panel_wall(rng: Random) -> tuple[Body, ...]:
    """Return a wall of panels with identical texture, so that features match in every panel."""
    side, gap = float(rng.uniform(0.5, 0.9)), 0.08
    panel = box(side, side, 0.08, spacing=0.1)
    columns = [(k - 3.5) * (side + gap) for k in range(8)]
    copies = [panel.move((x, 0.1 + row * (side + gap), -2.0)) for x in columns for row in range(3)]
    return (Body(assemble(copies, keep_texture=True), _draw_material(THING_MATERIALS, rng)),)


def wall(rng: Random) -> SyntheticScene:
    """Return a scene with only a flat wall that faces +z."""
    return SyntheticScene(
        "wall", (Body(box(11.0, 7.0, 0.1).move((0.0, -2.2, -0.1)), _draw_material(WALL_MATERIALS, rng)),)
    )


def moving_thing(rng: Random) -> tuple[Body, ...]:
    """Return an object about the size of a child, with its origin at its foot."""
    size = float(rng.uniform(0.7, 1.3))
    body = box(0.5 * size, 0.75 * size, 0.4 * size, spacing=0.08)
    head = ball(0.2 * size, bumps=0.1, seed=int(rng.integers(100))).move((0.0, 0.9 * size, 0.0))
    return Body(body, _with_scaled_pattern(_draw_material(THING_MATERIALS, rng), 0.6)), Body(
        head, _with_scaled_pattern(_draw_material(THING_MATERIALS, rng), 0.6)
    )


def fade_colors(scene: SyntheticScene, strength: float) -> SyntheticScene:
    """Return the scene with less color contrast, and thus few features.

    Args:
        scene: the original.
        strength: share in [0, 1] of the contrast that is kept.
    """
    return replace(
        scene, bodies=tuple(Body(body.shape, _fade_material(body.material, strength)) for body in scene.bodies)
    )


def equal_halves(scene: SyntheticScene) -> SyntheticScene:
    """Return the scene with every body but the ground a second time, half a turn about the y axis, and as it looks."""
    floor, *others = scene.bodies
    twice = (replace(body, shape=assemble([body.shape, body.shape.move(turn_deg=180.0)], True)) for body in others)
    return replace(scene, bodies=(floor, *twice))


def mixed_cameras(views: Views, count: int, reach: float, rng: Random) -> Views:
    """Return the photos by several cameras of one size, in turn at random.

    Args:
        views: before.
        count: of the cameras.
        reach: largest change of log f.
        rng: draws the cameras.
    """
    which = rng.permutation(np.arange(len(views.cameras)) % count)
    for number in range(count):
        names = [name for name, own in zip(sorted(views.cameras), which, strict=True) if own == number]
        if not names:
            continue
        camera = with_zoom(views.cameras[names[0]], math.exp(rng.uniform(-reach, reach)))
        views = views.with_camera(_with_moved_center(camera, rng.normal(0.0, 0.008, 2)), names)
    return views


def _random_thing(rng: Random, size: tuple[float, float] = (0.3, 0.9)) -> Shape:
    """Return a random object that stands on y = 0 around the y axis."""
    width, height, depth = rng.uniform(*size, 3)
    kind = int(rng.integers(4))
    if kind == 0:
        return box(width, height, depth, spacing=0.1)
    if kind == 1:
        return ball(0.5 * width, bumps=0.08 * float(rng.integers(2)), seed=int(rng.integers(100))).move(
            (0.0, 0.5 * width, 0.0)
        )
    if kind == 2:
        return torus(0.5 * width, 0.15 * width).move((0.0, 0.65 * width, 0.0), tilt_deg=float(rng.uniform(60.0, 90.0)))
    profile = np.array([[0.0, 0.0], [0.5 * width, 0.0], [0.35 * width, 0.6 * height], [0.45 * width, height]])
    return revolve(np.concatenate([profile, [[0.0, height]]]), segments=48, sharp=True)


def _draw_material(materials: tuple[Material, ...], rng: Random) -> Material:
    material = materials[int(rng.integers(len(materials)))]
    return _with_scaled_pattern(material, float(rng.uniform(0.6, 1.4)))


def _with_scaled_pattern(material: Material, factor: float) -> Material:
    return replace(material, scale=material.scale * factor)


def _fade_material(material: Material, strength: float) -> Material:
    def fade_color(color: tuple[int, int, int]) -> tuple[int, int, int]:
        r, g, b = (round(base + strength * (own - base)) for own, base in zip(color, material.base, strict=True))
        return r, g, b

    return replace(
        material,
        second=fade_color(material.second),
        joint=fade_color(material.joint),
        contrast=strength * material.contrast,
    )


WALKS = ("walk", "forward", "sideways", "orbit", "wide steps")
PLACES = ("things", "plane", "repeats", "look-alikes")
CAMERA_TROUBLES = ("two cameras", "zoom", "crop", "squeeze", "lens")
PHOTO_TROUBLES = ("motion blur", "defocus", "moving object", "few features")
RARE_TROUBLES = ("darkness", "haze", "equal halves", "mixed cameras")
"""Drawn after all others, by a generator of their own; three of ten folders have one."""
ORDINARY = ("walk", "things")
"""Choices that do not count as trouble."""
KINDS = tuple(
    kind for kind in (*WALKS, *PLACES, *CAMERA_TROUBLES, *PHOTO_TROUBLES, *RARE_TROUBLES) if kind not in ORDINARY
)
"""All troubles by name."""
SIZES = ((480, 320), (512, 384), (384, 512), (576, 384), (640, 480), (640, 400))
PHOTOS = (6, 20)
AIM = (0.0, 0.7, 0.0)
"""Point that the photos look at: the middle of the objects."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoDefects:
    """Defects of single photos."""

    blur_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """By photo name: length and direction (radians) of its motion blur."""
    defocus_px: Mapping[str, float] = field(default_factory=dict)
    """By photo name: standard deviation of its defocus blur, in pixels."""
    thing: SyntheticScene | None = None
    """Object that moves from photo to photo."""
    thing_at: Mapping[str, FloatArray] = field(default_factory=dict)
    """By photo name: (3, 4) world_from_thing."""
    grays: tuple[float, float] = (1.0, 0.0)
    """Factor on the gray levels, and what is added to them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TroubledFolder:
    """Plan of a folder of photos to render."""

    seed: int = 0
    troubles: tuple[str, ...]
    """Entries of `KINDS`, in their order; empty without trouble."""
    scene: SyntheticScene
    views: Views
    options: PhotoOptions
    spoiling: PhotoDefects = PhotoDefects()


def troubled_folder(seed: int) -> TroubledFolder:
    """Draw the plan of a folder: same seed, same plan."""
    rng = np.random.default_rng([seed, 29])
    walk = str(rng.choice(WALKS, p=(0.4, 0.15, 0.15, 0.15, 0.15)))
    place = str(rng.choice(PLACES, p=(0.55, 0.15, 0.15, 0.15)))
    of_cameras = _draw_kinds(CAMERA_TROUBLES, (0.35, 0.45, 0.2), rng)
    of_photos = _draw_kinds(PHOTO_TROUBLES, (0.4, 0.4, 0.2), rng)
    drawn = {walk, place, *of_cameras, *of_photos}
    scene = _draw_scene(place, rng)
    if "few features" in drawn:
        scene = fade_colors(scene, float(rng.uniform(0.1, 0.3)))
    camera = _draw_camera(drawn, rng)
    views = _with_cameras(_draw_views(walk, place, camera, rng), drawn, rng)
    rare = np.random.default_rng([seed, 56])
    drawn |= set(_draw_kinds(RARE_TROUBLES, (0.7, 0.3), rare))
    if "equal halves" in drawn:
        scene = equal_halves(scene)
    if "mixed cameras" in drawn:
        views = mixed_cameras(views, int(rare.integers(3, 7)), 0.3, rare)
    options = PhotoOptions(
        supersampling=1,
        noise=float(rng.uniform(0.5, 3.0)),
        blur_px=float(rng.uniform(0.4, 0.7)),
        quality=int(rng.integers(75, 95)),
        seed=seed,
    )
    return TroubledFolder(
        seed=seed,
        troubles=tuple(kind for kind in KINDS if kind in drawn),
        scene=scene,
        views=views,
        options=options,
        spoiling=replace(_draw_defects(drawn, views, rng), grays=_draw_grays(drawn, rare)),
    )


def write_troubled_folder(folder: Path, plan: TroubledFolder) -> Truth:
    """Render one JPEG per view into a folder; the truth is not written.

    Args:
        folder: created if missing.
        plan: from `troubled_folder`.

    Raises:
        InputError: the folder cannot be written.
    """
    still, spoiling = prepare(plan.scene), plan.spoiling
    moving = None if spoiling.thing is None else prepare(spoiling.thing)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for k, (name, pose) in enumerate(plan.views.cam_from_world.items()):
            camera, over = plan.views.cameras[name], plan.options.supersampling
            image = render_scene(still, camera, pose, over)
            if moving is not None:
                at = cam_from_thing(pose, spoiling.thing_at[name])
                image = composite_moving(image, (still, pose), (moving, at), camera, over)
            image = apply_motion_blur(image, *spoiling.blur_px.get(name, (0.0, 0.0)))
            sharpness = replace(plan.options, blur_px=max(plan.options.blur_px, spoiling.defocus_px.get(name, 0.0)))
            photo = develop(image, sharpness, np.random.default_rng([plan.seed, k, 31]))
            photo = np.round(spoiling.grays[0] * photo + spoiling.grays[1]).astype(np.uint8)
            Image.fromarray(photo).save(folder / name, format="JPEG", quality=plan.options.quality)
    except OSError as err:
        raise InputError(f"cannot write photos to {folder}: {err}", hint="choose another folder") from err
    return Truth(dict(plan.views.cameras), dict(plan.views.cam_from_world), plan.scene.vertices, plan.scene.faces)


def apply_motion_blur(image: FloatArray, length_px: float, direction: float) -> FloatArray:
    """Apply the motion blur of a camera that turned during the exposure: average along a line.

    Args:
        image: (H, W, 3) linear RGB.
        length_px: of the line; below 1, the image is returned unchanged.
        direction: of the line, in radians from x towards y.
    """
    if length_px < 1:
        return image
    steps = np.linspace(-0.5, 0.5, 2 * math.ceil(length_px) + 1) * length_px
    x, y = steps * math.cos(direction), steps * math.sin(direction)
    half = math.ceil(length_px / 2) + 1
    weights = np.zeros((2 * half + 1, 2 * half + 1))
    for column, row in zip(x, y, strict=True):
        left, top = math.floor(column), math.floor(row)
        for i, share_y in ((0, 1 - row + top), (1, row - top)):
            for j, share_x in ((0, 1 - column + left), (1, column - left)):
                weights[half + top + i, half + left + j] += share_x * share_y
    blurred = cv2.filter2D(image, -1, weights / weights.sum(), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=np.float64)


SceneView = tuple[PreparedScene, FloatArray]
"""A scene, and the pose (3, 4) of the camera in its frame."""


def composite_moving(
    image: FloatArray, still: SceneView, moving: SceneView, camera: Camera, supersampling: int
) -> FloatArray:
    """Return the image of the still scene with the moving object where it is nearer; the object casts no shadow.

    Args:
        image: (H, W, 3) linear RGB of the still scene.
        still: scene and pose of the camera in it.
        moving: scene of the moving object and pose of the camera in it.
        camera: of the image.
        supersampling: rays per pixel in x and in y, >= 1.
    """
    depth = []
    for scene, pose in (still, moving):
        directions = pixel_rays(camera) @ pose[:, :3]
        depth.append(cast_rays(scene.rays, camera_center(pose), directions)["t_hit"].reshape(image.shape[:2]))
    nearer = depth[1] < depth[0]
    if not nearer.any():
        return image
    return np.where(nearer[..., None], render_scene(moving[0], camera, moving[1], supersampling), image)


def cam_from_thing(cam_from_world: FloatArray, world_from_thing: FloatArray) -> FloatArray:
    """Return the (3, 4) pose of the camera in the frame of an object.

    Args:
        cam_from_world: (3, 4) pose of the camera.
        world_from_thing: (3, 4) pose of the object.
    """
    R, t = cam_from_world[:, :3], cam_from_world[:, 3]
    return np.column_stack([R @ world_from_thing[:, :3], R @ world_from_thing[:, 3] + t])


def _draw_kinds(kinds: tuple[str, ...], shares: tuple[float, ...], rng: Random) -> list[str]:
    """Draw k of the kinds, where k = 0, 1, ... has the probability shares[k]."""
    return [str(kind) for kind in rng.choice(kinds, int(rng.choice(len(shares), p=shares)), replace=False)]


def _draw_scene(place: str, rng: Random) -> SyntheticScene:
    if place == "plane":
        return wall(rng)
    things = heap_of_things(rng)
    if place == "repeats":
        things = (*things, *panel_wall(rng))
    elif place == "look-alikes":
        things = (*things, *repeated_things(rng))
    light = (float(rng.uniform(-0.6, 0.6)), 0.8, float(rng.uniform(0.3, 0.8)))
    return SyntheticScene(place, things, to_light=light)


def _draw_camera(drawn: set[str], rng: Random) -> Camera:
    """Draw the camera of a folder; its optical center, pixel aspect and lens may be among the troubles."""
    width, height = (int(side) for side in rng.choice(SIZES))
    longer = math.exp(rng.uniform(math.log(0.75), math.log(1.6)))
    center = 0.5 + rng.normal(0.0, 0.008, 2)
    if "crop" in drawn:
        center = center + rng.choice((-1.0, 1.0), 2) * rng.uniform(0.04, 0.16, 2)
    aspect = float(rng.choice((0.75, 0.85, 1.2, 1.33))) if "squeeze" in drawn else 1.0
    camera = make_camera(width, height, longer * max(width, height) / width, (center[0], center[1]), aspect)
    # relative displacement of a corner; phones correct their lenses to about half a percent
    bend = rng.choice((-1.0, 1.0)) * rng.uniform(0.03, 0.1) if "lens" in drawn else rng.normal(0.0, 0.003)
    return with_distortion(camera, float(bend))


def with_distortion(camera: Camera, bend: float) -> Camera:
    """Return the camera with the radial distortion that moves the farthest corner outwards by a share.

    Args:
        camera: its own distortion is replaced.
        bend: k1 r^2 at the corner; < 0: inwards.
    """
    corners = np.array([[x, y] for x in (0.0, camera.width) for y in (0.0, camera.height)])
    seen = (corners - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    return replace(camera, lens=Lens(radial=(bend / float((seen**2).sum(axis=1).max()),)))


def with_zoom(camera: Camera, factor: float) -> Camera:
    """Return the camera with another focal length and the same distortion in pixels.

    Args:
        camera: before the zoom.
        factor: new over old focal length, > 0.
    """
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= factor
    return replace(camera, K=K, lens=Lens(radial=(camera.radial * factor**2,)))


def _with_moved_center(camera: Camera, shares: FloatArray) -> Camera:
    K = camera.K.copy()
    K[:2, 2] += shares * (camera.width, camera.height)
    return replace(camera, K=K)


def _draw_views(walk: str, place: str, camera: Camera, rng: Random) -> Views:
    count = int(rng.integers(PHOTOS[0], PHOTOS[1] + 1))
    longer = camera.K[0, 0] / max(camera.width, camera.height)
    distance = 4.6 * max(1.0, longer) * float(rng.uniform(0.9, 1.2))
    seed = int(rng.integers(1 << 30))
    if walk == "orbit":
        sweep = float(rng.uniform(40, 150 if place == "things" else 80))
        return orbit(camera, count, sweep, distance, (AIM[0], AIM[1] + 0.4, AIM[2]))
    if walk in ("forward", "sideways"):
        return _straight_walk(walk, camera, count, distance, rng)
    wide = walk == "wide steps"
    sweep = min(float(rng.uniform(18, 26) if wide else rng.uniform(5, 12)) * (count - 1), 150.0 if wide else 100.0)
    path = ArcOptions(
        photos=min(count, 8) if wide else count, sweep_deg=sweep, distance=(0.85 * distance, 1.2 * distance),
        height=(0.7, 2.4), aim=AIM, aim_spread=0.35, roll_deg=10.0,
    )  # fmt: skip
    return arc(camera, path, seed)


def _straight_walk(walk: str, camera: Camera, count: int, distance: float, rng: Random) -> Views:
    """Return a straight path with a fixed viewing direction: ahead, as from a car, or sideways, as from a train."""
    along = np.linspace(0.5, -0.5, count) + rng.normal(0.0, 0.1 / count, count)
    way = np.zeros((count, 3))
    if walk == "forward":
        way[:, 2] = 1.3 * distance + 0.9 * distance * along
    else:
        way[:, 0], way[:, 2] = 3.2 * along, distance
    way += np.array([0.0, 1.3, 0.0]) + rng.normal(0.0, 0.02, (count, 3))
    aims = way + np.array([0.0, -0.1, -1.0]) + rng.normal(0.0, 0.02, (count, 3))
    return Views.from_poses(
        camera, [look_at(c, a, float(rng.normal(0.0, 1.0))) for c, a in zip(way, aims, strict=True)]
    )


def _with_cameras(views: Views, drawn: set[str], rng: Random) -> Views:
    names = sorted(views.cameras)
    if "two cameras" in drawn:
        factor = float(rng.choice((0.65, 0.8, 1.25, 1.5)))
        center = rng.normal(0.0, 0.01, 2)
        other = _with_moved_center(with_zoom(views.cameras[names[0]], factor), center)
        # alternating or one after the other, as with two photographers or one with two cameras
        turn = names[1::2] if rng.uniform() < 0.5 else names[: len(names) // 2]
        views = views.with_camera(other, turn)
    if "zoom" in drawn:
        reach = float(rng.uniform(0.1, 0.4))
        for name in names:
            views = views.with_camera(with_zoom(views.cameras[name], math.exp(rng.uniform(-reach, reach))), [name])
    return views


def _draw_defects(drawn: set[str], views: Views, rng: Random) -> PhotoDefects:
    names = sorted(views.cameras)
    spoilt = [name for name in names if rng.uniform() < 0.6]
    blur = {name: (float(rng.uniform(2, 9)), float(rng.uniform(0, math.pi))) for name in spoilt}
    defocus = {name: float(rng.uniform(1.0, 2.5)) for name in names if rng.uniform() < 0.6}
    thing = moving_thing(rng)
    return PhotoDefects(
        blur_px=blur if "motion blur" in drawn else {},
        defocus_px=defocus if "defocus" in drawn else {},
        thing=SyntheticScene("thing", thing) if "moving object" in drawn else None,
        thing_at=_random_walk(names, rng),
    )


def _draw_grays(drawn: set[str], rng: Random) -> tuple[float, float]:
    """Draw how much darker, or how hazy, the photos are."""
    share = float(rng.uniform(0.06, 0.2))
    return (share, float(rng.uniform(150, 200)) if "haze" in drawn else 3.0) if drawn & {"darkness", "haze"} else (1, 0)


def _random_walk(names: list[str], rng: Random) -> dict[str, FloatArray]:
    """Draw a random walk with random turns in front of the objects: (3, 4) world_from_thing by photo."""
    place, angle = np.array([rng.uniform(-1.0, 1.0), 0.0, rng.uniform(1.0, 1.8)]), rng.uniform(0.0, 360.0)
    found = {}
    for name in names:
        found[name] = np.column_stack([axis_rotation(np.array([0.0, 1.0, 0.0]), angle), place])
        step = rng.normal(0.0, 0.35, 2)
        place = np.clip(place + np.array([step[0], 0.0, 0.4 * step[1]]), [-1.6, 0.0, 0.8], [1.6, 0.0, 2.2])
        angle += rng.normal(0.0, 25.0)
    return found
