"""Holes in what photos see are closed where they see nothing else, and borders stay open."""

from dataclasses import dataclass

import numpy as np
import pytest

from sfm_app.colmap.dense import write_depth
from sfm_app.geometry.triangles import areas, unique_edges
from sfm_app.meshing.tetrahedra import Cloud
from sfm_app.meshing.visibility import SKY
from sfm_app.stereo import View
from sfm_app.surface.spanning import Evidence, gather, smooth, span
from sfm_app.synthetic.cameras import look_at
from sfm_app.synthetic.shapes import grid
from sfm_app.types import Surface

STEP, WIDTH = 0.025, 200
MASKED = -1.0


def view_at(name, center, target=(0.0, 0.0, 0.0)):
    K = np.array([[240.0, 0.0, WIDTH / 2], [0.0, 240.0, WIDTH / 2], [0.0, 0.0, 1.0]])
    return View(name, K, look_at(np.array(center), np.array(target)), WIDTH, WIDTH)


ABOVE = [
    view_at(f"{k}.png", (x, y, 4.0)) for k, (x, y) in enumerate([(0.6, 0.1), (-0.5, 0.8), (-0.2, -0.7), (0.9, -0.9)])
]


def plane_depths(view, z):
    """Depths (H, W) of the plane at a height, and where it is shown (H, W, 2)."""
    pixels = np.stack(np.meshgrid(*[np.arange(WIDTH) + view.sample_px] * 2), axis=-1)
    rays = view.rays(pixels)
    depth = (z - view.center[2]) / (rays @ view.R[:, 2])
    return depth, (view.center + (rays @ view.R) * depth[..., None])[..., :2]


@dataclass
class Sheet:
    """A square of side 2 at z = 0, with a square hole in its middle."""

    hole: float
    shows: str
    """What photos show in the hole: "nothing", "mask", "sky" or "wall"."""

    def depths(self, view):
        """Depths (H, W), 0 beside the sheet."""
        depth, at = plane_depths(view, 0.0)
        wall, _ = plane_depths(view, -1.0)
        inside = {"nothing": 0.0, "mask": MASKED, "sky": SKY, "wall": wall}[self.shows]
        reach = np.abs(at).max(axis=-1)
        return np.where(reach > 1.0, 0.0, np.where(reach < self.hole / 2, inside, depth)).astype(np.float32)

    @property
    def cloud(self):
        rng = np.random.default_rng(0)
        places, _ = grid(*[np.linspace(-1.0, 1.0, round(2.0 / STEP) + 1)] * 2)
        places = places[np.abs(places).max(axis=1) >= self.hole / 2]
        points = np.column_stack([places, np.zeros(len(places))]) + 0.1 * STEP * rng.normal(size=(len(places), 3))
        count = len(points)
        colors = rng.integers(0, 256, (count, 3)).astype(np.uint8)
        return Cloud(points, np.tile([0.0, 0.0, 1.0], (count, 1)), colors, np.full(count, STEP))


@pytest.fixture
def seen(tmp_path):
    """Spans the surface of a cloud seen by views with the depths that a function gives."""

    def span_seen(cloud, views, depths, **options):
        for view in views:
            write_depth(tmp_path, view, depths(view))
        return span(cloud, Evidence(tmp_path, views, 0.01), **options)

    return span_seen


def total(surface):
    return areas(surface.vertices, surface.faces).sum()


def open_edges(surface):
    """(E, 2) edges with one triangle."""
    edges, edge_of = unique_edges(surface.faces)
    return edges[np.bincount(edge_of.ravel()) == 1]


NARROW, WIDE = 0.5, 1.2
"""Sides of holes: 20 and 48 distances of points; a square is narrow up to 32."""


@pytest.mark.parametrize(
    ("hole", "shows", "closed"),
    [
        (NARROW, "nothing", True),
        (WIDE, "nothing", True),  # photos look at it
        (NARROW, "mask", True),
        (WIDE, "mask", False),  # no photo tells what is there
        (NARROW, "wall", False),
        (WIDE, "wall", False),
        (NARROW, "sky", False),
        (WIDE, "sky", False),
    ],
)
def test_holes_are_closed_unless_photos_see_through_them(seen, hole, shows, closed):
    sheet = Sheet(hole, shows)

    found, witnesses = seen(sheet.cloud, ABOVE, sheet.depths)

    assert total(found) == pytest.approx(4.0 if closed else 4.0 - hole**2, abs=0.1)
    middle = np.abs(found.vertices[found.faces].mean(axis=1)[:, :2]).max(axis=1) < 0.3 * hole
    assert middle.any() == closed
    border = found.vertices[open_edges(found)]
    length = np.linalg.norm(border[:, 0] - border[:, 1], axis=1)
    is_outer = np.abs(border[..., :2]).max(axis=(1, 2)) > 0.9
    assert length[is_outer].sum() == pytest.approx(8.0, rel=0.05)
    assert length[~is_outer].sum() == pytest.approx(0.0 if closed else 4.0 * hole, abs=0.6)
    corners = found.vertices[found.faces]
    upward = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2].sum()
    assert upward == pytest.approx(total(found), rel=0.02)
    assert [view.name for view in witnesses] == [view.name for view in ABOVE]


def test_one_photo_that_sees_through_a_hole_counts_less_than_two_that_see_nothing(seen):
    nothing, wall = Sheet(WIDE, "nothing"), Sheet(WIDE, "wall")
    one, _ = seen(nothing.cloud, ABOVE, lambda view: (wall if view is ABOVE[0] else nothing).depths(view))
    most, _ = seen(nothing.cloud, ABOVE, lambda view: (nothing if view is ABOVE[0] else wall).depths(view))

    assert total(one) == pytest.approx(4.0, rel=0.03)
    assert total(most) == pytest.approx(4.0 - WIDE**2, abs=0.1)


@pytest.mark.parametrize(("share", "closed"), [(0.15, True), (0.6, False)])
def test_a_hole_is_closed_if_photos_see_through_little_of_it(seen, share, closed):
    nothing, wall = Sheet(WIDE, "nothing"), Sheet(WIDE, "wall")

    def depths(view):
        left = plane_depths(view, 0.0)[1][..., 0] < (share - 0.5) * WIDE
        return np.where(left, wall.depths(view), nothing.depths(view))

    found, _ = seen(nothing.cloud, ABOVE, depths)

    assert total(found) == pytest.approx(4.0 if closed else 4.0 - WIDE**2, abs=0.15)


def test_points_that_more_photos_see_through_than_confirm_are_left_out(seen):
    """One photo shows a leaf in a hole where the three others show the sky."""
    sheet = Sheet(WIDE, "sky")
    places, _ = grid(*[np.linspace(-0.15, 0.15, 13)] * 2)
    leaf, count = np.column_stack([places, np.zeros(len(places))]), len(sheet.cloud.points) + len(places)
    points, colors = np.concatenate([sheet.cloud.points, leaf]), np.zeros((count, 3), np.uint8)
    cloud = Cloud(points, np.tile([0.0, 0.0, 1.0], (count, 1)), colors, np.full(count, STEP))

    def depths(view):
        depth, at = plane_depths(view, 0.0)
        is_leaf = (view is ABOVE[0]) & (np.abs(at).max(axis=-1) < 0.2)
        return np.where(is_leaf, depth, sheet.depths(view)).astype(np.float32)

    found, _ = seen(cloud, ABOVE, depths)

    assert np.abs(found.vertices[:, :2]).max(axis=1).min() > 0.2


def test_a_photo_that_confirms_little_is_no_witness(seen):
    sheet = Sheet(0.0, "nothing")
    aside = view_at("aside.png", (0.0, 0.0, 4.0), (2.95, 0.0, 0.0))

    _, witnesses = seen(sheet.cloud, [*ABOVE, aside], sheet.depths)

    assert [view.name for view in witnesses] == [view.name for view in ABOVE]


def test_without_photos_that_confirm_points_there_is_no_surface(seen):
    found, witnesses = seen(Sheet(0.0, "nothing").cloud, ABOVE, lambda _: np.zeros((WIDTH, WIDTH), np.float32))

    assert (found.vertices.shape, found.faces.shape, found.colors.shape) == ((0, 3), (0, 3), (0, 3))
    assert witnesses == []


def ball_depths(view):
    pixels = np.stack(np.meshgrid(*[np.arange(WIDTH) + view.sample_px] * 2), axis=-1)
    rays = view.rays(pixels)
    a, b = np.sum(rays**2, axis=-1), rays @ view.t
    root = b**2 - a * (view.t @ view.t - 1.0)
    return np.where(root > 0.0, (b - np.sqrt(root.clip(min=0.0))) / a, 0.0).astype(np.float32)


@pytest.mark.parametrize("close", [False, True])
def test_what_no_photo_sees_is_open_or_closed_as_asked(seen, close):
    """Photos from above show the upper part of a ball."""
    step = 0.04
    count = round(4.0 * np.pi / step**2)
    height, turn = 1.0 - (2.0 * np.arange(count) + 1.0) / count, np.pi * (1.0 + 5.0**0.5) * np.arange(count)
    width = np.sqrt(1.0 - height**2)
    normals = np.column_stack([width * np.cos(turn), width * np.sin(turn), height])[height > -0.1]
    noise = 1.0 + 0.05 * step * np.random.default_rng(0).normal(size=(len(normals), 1))
    cloud = Cloud(normals * noise, normals, np.zeros((len(normals), 3), np.uint8), np.full(len(normals), step))
    around = [view_at(f"{k}.png", (3.5 * np.cos(k), 3.5 * np.sin(k), 2.0)) for k in range(6)]

    found, _ = seen(cloud, around, ball_depths, close=close)

    seen_area = 2.0 * np.pi * 1.1  # of a cap
    assert total(found) == pytest.approx(seen_area + np.pi * (1 - 0.1**2) * close, rel=0.05)
    assert (len(open_edges(found)) == 0) == close
    assert np.median(np.linalg.norm(found.vertices, axis=1)) == pytest.approx(1.0, abs=0.01)


def test_the_same_evidence_gives_the_same_bytes(seen):
    sheet = Sheet(NARROW, "nothing")
    (one, _), (other, _) = (seen(sheet.cloud, ABOVE, sheet.depths) for _ in range(2))
    for name in ("vertices", "faces", "colors"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def records_at(points):
    names = [*"xyz", "nx", "ny", "nz"]
    found = np.zeros(len(points), [*((name, "<f4") for name in names), *((c, "u1") for c in ("red", "green", "blue"))])
    for name, values in zip("xyz", np.transpose(points), strict=True):
        found[name] = values
    found["nz"], found["green"] = 1.0, 77
    return found


def test_points_are_as_dense_as_the_pixels_of_the_closest_photo():
    """A pixel at depth 4 is 4/240 wide; what no photo shows is left out."""
    far, near = view_at("far.png", (0.0, 0.0, 4.0)), view_at("near.png", (0.8, 0.0, 1.0), (0.8, 0.0, 0.0))
    places = np.array([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, 9.0]])

    found = gather(records_at(places), [far, near])

    order = np.argsort(found.points[:, 0])
    np.testing.assert_allclose(found.points[order], places[:2], atol=1e-6)
    np.testing.assert_allclose(found.step[order], 2.5 / 240.0 * np.array([4.0, 1.0]), rtol=1e-6)
    np.testing.assert_allclose(found.normals, [[0.0, 0.0, 1.0]] * 2)
    np.testing.assert_array_equal(found.colors, [[0, 77, 0]] * 2)


def test_smoothing_takes_noise_away_and_keeps_the_border_in_place():
    places, faces = grid(np.arange(31.0), np.arange(31.0))
    rng = np.random.default_rng(0)
    inner = np.abs(places - 15.0).max(axis=1) < 15.0
    rough = Surface(np.column_stack([places, 0.3 * inner * rng.normal(size=len(places))]), faces,
                    rng.integers(0, 256, (len(places), 3)).astype(np.uint8))  # fmt: skip

    found = smooth(rough)

    assert found.vertices[inner, 2].std() < 0.5 * rough.vertices[inner, 2].std()
    edge = np.abs(places[:, 0] - 15.0) == 15.0
    middle = np.abs(places[:, 1] - 15.0) < 12.0
    np.testing.assert_allclose(found.vertices[edge & middle], rough.vertices[edge & middle], atol=1e-9)
    np.testing.assert_array_equal(found.faces, rough.faces)
    np.testing.assert_array_equal(found.colors, rough.colors)


SIDES = [
    (np.array(out), np.array(along))
    for out, along in (((1, 0), (0, 1)), ((0, 1), (-1, 0)), ((-1, 0), (0, -1)), ((0, -1), (1, 0)))
]
"""Directions out of the four sides of a box, and along them."""


def box_cloud(height, inward, ground=1.0):
    """Points on the sides of a box from -1 to 1 and of a height, with normals to its outside or its inside.

    Those of its ground are at least `ground` from its middle.
    """
    ticks = [np.linspace(low, high, round((high - low) / STEP) + 1) for low, high in ((-1, 1), (-1, 1), (0, height))]
    along, up = grid(*ticks[1:])[0].T
    points, normals = [], []
    for out, side in SIDES:
        points.append(np.column_stack([out + along[:, None] * side, up]))
        normals.append(np.tile([*(-out if inward else out), 0.0], (len(up), 1)))
    flat = grid(*ticks[:2])[0]
    flat = flat[np.abs(flat).max(axis=1) > ground]
    points.append(np.column_stack([flat, np.zeros(len(flat))]))
    normals.append(np.tile([0.0, 0.0, 1.0], (len(flat), 1)))
    at = np.concatenate(points)
    at += 0.1 * STEP * np.random.default_rng(0).normal(size=at.shape)
    return Cloud(at, np.concatenate(normals), np.zeros((len(at), 3), np.uint8), np.full(len(at), STEP))


def box_depths(view, height, ground=1.0):
    """Depths (H, W) of the box, seen from inside or outside; 0 on its top, its unknown ground, and beside it."""
    pixels = np.stack(np.meshgrid(*[np.arange(WIDTH) + view.sample_px] * 2), axis=-1)
    rays = view.rays(pixels) @ view.R
    with np.errstate(divide="ignore"):
        ends = (np.array([[-1, -1, 0], [1, 1, height]])[:, None, None] - view.center) / rays
    enter, leave = ends.min(axis=0), ends.max(axis=0)
    inside = np.abs(view.center[:2]).max() < 1.0
    axis = np.argmin(leave, axis=-1) if inside else np.argmax(enter, axis=-1)
    depth = np.take_along_axis(leave if inside else enter, axis[..., None], axis=-1)[..., 0]
    place = view.center + rays * depth[..., None]
    known = (axis < 2) | ((place[..., 2] < 0.1) & (np.abs(place[..., :2]).max(axis=-1) > ground))
    return np.where(known & (enter.max(axis=-1) <= leave.min(axis=-1)), depth, 0.0).astype(np.float32)


def around(distance, height, target):
    return [view_at(f"{k}.png", (distance * np.cos(k), distance * np.sin(k), height), target) for k in range(6)]


def test_the_unknown_ground_of_a_court_is_closed(seen):
    views = [
        view_at(f"{k}.png", (0.6 * np.cos(k), 0.6 * np.sin(k), 0.4), (-9 * np.cos(k), -9 * np.sin(k), 0.3))
        for k in range(12)
    ]

    found, _ = seen(box_cloud(0.6, True, ground=0.96), views, lambda view: box_depths(view, 0.6, ground=0.97))

    assert total(found) == pytest.approx(4 * 2 * 0.6 + 4.0, rel=0.08)


def test_no_photo_sees_the_inside_of_a_body(seen):
    """Photos at a low angle show no depth on a plain top; without it they would show the backs of the sides."""
    views = around(5.0, 1.8, (0.0, 0.0, 0.5))

    found, _ = seen(box_cloud(1.0, False), views, lambda view: box_depths(view, 1.0))

    assert total(found) == pytest.approx(4 * 2.0 + 4.0, rel=0.05)
