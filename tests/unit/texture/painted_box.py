"""A painted box, and photos of it: rendered analytically, nothing shared with the code under test."""

from dataclasses import dataclass, field
from functools import cache

import numpy as np

from sfm_app.camera.models import camera_matrix
from sfm_app.settings import TextureSettings
from sfm_app.texture.assemble import texture_surface
from sfm_app.texture.sightings import facets, make_sightings
from sfm_app.texture.views import PhotoView
from sfm_app.types import Surface

HALF = np.array([1.0, 0.7, 0.8])


def sightings(score, colors=None):
    """Sightings from (P, T) scores, 0 for hidden triangles, and (P, T, 3) colors."""
    photo, face = np.nonzero(score)
    color = np.zeros((len(face), 3), np.uint8) if colors is None else colors[photo, face]
    counts = np.bincount(photo, minlength=len(score))
    return make_sightings(counts, face.astype(np.int32), score[photo, face].astype(np.float32), color, score.shape[1])


def paint_at(points):
    """(N, 3) RGB of the box at points in space: smooth, different everywhere."""
    x, y, z = points.T
    waves = [np.sin(9 * x + 4 * y) + np.cos(7 * z), np.sin(8 * y - 5 * z) + np.cos(6 * x), np.sin(9 * z + 3 * x + y)]
    return 128 + 35 * np.stack(waves, axis=1)


def box(steps=12):
    """Six sides of steps x steps squares; vertices of the sides are shared."""
    vertices, faces = [], []
    grid = np.linspace(-1, 1, steps + 1)
    a, b = (part.ravel() for part in np.meshgrid(grid, grid, indexing="ij"))
    corner = (np.arange(steps)[:, None] * (steps + 1) + np.arange(steps)).ravel()
    quads = np.column_stack([corner, corner + steps + 1, corner + steps + 2, corner + 1])
    for axis in range(3):
        for side in (-1.0, 1.0):
            points = np.empty((len(a), 3))
            points[:, axis], points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = side, a, b
            order = quads if side > 0 else quads[:, ::-1]
            faces += [np.concatenate([order[:, [0, 1, 2]], order[:, [0, 2, 3]]]) + sum(map(len, vertices))]
            vertices.append(points)
    merged, place = np.unique(np.round(np.concatenate(vertices), 9), axis=0, return_inverse=True)
    colors = np.full((len(merged), 3), 77, np.uint8)
    return Surface(merged * HALF, place.ravel()[np.concatenate(faces)].astype(np.int64), colors)


def around(count=9, size=(320, 240), height=1.6, k1=-0.05):
    """Photos from a circle above the box: its bottom is hidden."""
    views = []
    for angle in 2 * np.pi * np.arange(count) / count:
        center = np.array([4.0 * np.cos(angle), height, 4.0 * np.sin(angle)])
        forward = -center / np.linalg.norm(center)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        K = camera_matrix(1.3 * size[0], 1.3 * size[0], size[0] / 2 + 3.0, size[1] / 2 - 2.0)
        name, lens = f"{len(views):03}.png", (k1, 0.01, 0, 0, 0, 0, 0, 0)
        views.append(PhotoView(name, K, np.column_stack([R, -R @ center]), *size, name, lens))
    return views


@cache
def photograph(view):
    """(height, width, 3) uint8: each pixel's ray through the lens, intersected with the box."""
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    fx, fy, cx, cy, k1, k2, *_ = view.lens
    distorted = np.column_stack([(x.ravel() - cx) / fx, (y.ravel() - cy) / fy])
    plane = distorted.copy()
    for _ in range(30):
        r2 = np.sum(plane**2, axis=1, keepdims=True)
        plane = distorted / (1 + k1 * r2 + k2 * r2**2)
    rays = np.column_stack([plane, np.ones(len(plane))]) @ view.cam_from_world[:, :3]
    near, far = (-HALF - view.center) / rays, (HALF - view.center) / rays
    enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
    photo = np.full((len(rays), 3), 25.0)
    hit = enter < leave
    photo[hit] = paint_at(view.center + enter[hit, None] * rays[hit])
    return np.round(photo).astype(np.uint8).reshape(view.height, view.width, 3)


@dataclass
class Album:
    """A store in memory: photos, masks, and kept arrays."""

    exposure: dict[str, float] = field(default_factory=dict)
    passers_by: dict[str, tuple[slice, slice]] = field(default_factory=dict)
    masks: dict[str, np.ndarray] = field(default_factory=dict)
    lost: tuple[str, ...] = ()
    kept: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    read: list[str] = field(default_factory=list)

    def recall(self, name):
        return self.kept.get(name)

    def keep(self, name, arrays):
        self.kept[name] = {key: array.copy() for key, array in arrays.items()}

    def usable_pixels(self, view):
        return self.masks.get(view.name)

    def photo(self, view):
        self.read.append(view.name)
        if view.name in self.lost:
            raise FileNotFoundError(2, "No such file or directory")
        photo = photograph(view).astype(float)
        if view.name in self.passers_by:
            photo[self.passers_by[view.name]] = (250, 0, 240)
        return np.round(photo * self.exposure.get(view.name, 1.0)).astype(np.uint8)


def one_by_one(function, items, label):
    """Run work for each item in turn."""
    return [function(item) for item in items]


def textured(album, surface, views, spread=one_by_one, **options):
    """The textured model of a surface, and its figures."""
    return texture_surface(surface, views, album, TextureSettings(**options), spread)


def assert_same_texture(one, other):
    for ours, theirs in zip(one.texture.pages, other.texture.pages, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(one.texture.uv, other.texture.uv)
    np.testing.assert_array_equal(one.surface.colors, other.surface.colors)


def on_surface(model, count=4000, seed=0, among=None):
    """Random points (N, 3) of a textured surface, and the texture's colors there."""
    rng = np.random.default_rng(seed)
    faces = rng.choice(np.arange(len(model.surface.faces)) if among is None else np.flatnonzero(among), count)
    parts = rng.dirichlet([1.0, 1.0, 1.0], count)
    points = np.einsum("nk,nkc->nc", parts, model.surface.vertices[model.surface.faces[faces]])
    uv = np.einsum("nk,nkc->nc", parts, model.texture.uv[faces].astype(float))
    colors = np.empty((count, 3))
    for number, page in enumerate(model.texture.pages):
        here = model.texture.page[faces] == number
        colors[here] = read_page(page, uv[here])
    return points, colors


def read_page(page, uv):
    """Bilinear colors, as in viewers."""
    size = np.array([page.shape[1], page.shape[0]])
    at = np.clip(uv * size - 0.5, 0, size - 1)
    low = np.floor(at).astype(int)
    high = np.minimum(low + 1, size - 1)
    a, b = (at - low).T[:, :, None]
    values = page.astype(float)
    upper = (1 - a) * values[low[:, 1], low[:, 0]] + a * values[low[:, 1], high[:, 0]]
    lower = (1 - a) * values[high[:, 1], low[:, 0]] + a * values[high[:, 1], high[:, 0]]
    return (1 - b) * upper + b * lower


def strip(squares_along=4):
    """A flat band of unit squares, two triangles each."""
    x = np.arange(squares_along + 1.0)
    vertices = np.concatenate([np.column_stack([x, 0 * x, 0 * x]), np.column_stack([x, 0 * x + 1, 0 * x])])
    k, n = np.arange(squares_along), squares_along + 1
    faces = np.concatenate([np.column_stack([k, k + 1, k + 1 + n]), np.column_stack([k, k + 1 + n, k + n])])
    return facets(Surface(vertices, faces.astype(np.int64), np.zeros((2 * n, 3), np.uint8)))
