import json

import numpy as np
import pytest
from PIL import Image

from benchmarks.surface.bars import BARS, bar_rows
from benchmarks.surface.depth_camera.kinect import (
    FOCAL_PX,
    HEIGHT,
    WIDTH,
    KinectTruth,
    compare_cameras,
    kinect_scores,
    load_kinect,
    within_reach,
)
from benchmarks.surface.depth_camera.scan import PATCH, Scan, align
from benchmarks.surface.sets import SCANNED, surface_set
from sfm_app.geometry.poses import Similarity
from sfm_app.synthetic.cameras import Camera, axis_rotation, look_at
from sfm_app.types import Surface
from sfm_app.types.scene import camera_center
from tests.unit.benchmarks.test_surface import joined

CELL = 0.015
SIZE = np.array([1.7, 1.2, 1.5])
"""Of the room, in meters."""
WORLD = Similarity(0.4, axis_rotation(np.array([0.6, 0.0, 0.8]), 40.0), np.array([3.0, -1.0, 2.0]))
"""From the truth to the frame of the reconstruction."""
DEPTH_CAMERA = Camera(np.array([[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1.0]]), WIDTH, HEIGHT)


def cell_means(points):
    """Points as a scan has them: the mean of each cell that holds at least three."""
    _, which, count = np.unique(np.floor(points / CELL), axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(count), 3))
    np.add.at(sums, which.ravel(), points)
    return (sums / count[:, None])[count >= 3]


def plane_scan(noise, rng, side=0.6):
    """A scan of a tilted square at the origin, and its normal."""
    R = axis_rotation(np.array([0.8, 0.6, 0.0]), 33.0)
    flat = np.column_stack([rng.uniform(-side / 2, side / 2, (40_000, 2)), rng.normal(scale=noise, size=40_000)])
    return Scan.from_points(cell_means(flat @ R.T)), R


@pytest.mark.parametrize("noise", [0.0, 0.004, 0.012])
@pytest.mark.parametrize("height", [-0.045, -0.02, 0.0, 0.03])
def test_distances_from_a_plane_are_those_from_its_middle(noise, height):
    rng = np.random.default_rng(0)
    scan, R = plane_scan(noise, rng)
    places = np.column_stack([rng.uniform(-0.2, 0.2, (2000, 2)), np.full(2000, height)]) @ R.T
    found = scan.distances(places)
    assert np.median(found) == pytest.approx(abs(height), abs=0.0015 + 0.1 * noise)
    assert np.quantile(np.abs(found - abs(height)), 0.9) < 0.002 + 0.4 * noise
    assert np.nanmedian(scan.roughness) < 0.5 * CELL + noise


def test_distances_from_a_sphere_and_beyond_the_edge_of_a_plane():
    rng = np.random.default_rng(1)
    ways = rng.normal(size=(200_000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    scan = Scan.from_points(cell_means(0.4 * ways))
    for radius in (0.37, 0.4, 0.43):
        found = scan.distances(radius * ways[:3000])
        assert np.median(found) == pytest.approx(abs(radius - 0.4), abs=0.0025)
    flat, R = plane_scan(0.0, rng)
    beside = flat.distances(np.array([[0.4, 0.0, 0.0]]) @ R.T)
    assert 0.1 - PATCH - 0.01 < beside[0] <= 0.1, "10 cm beyond the edge; the plane goes on for a cell"
    assert Scan.from_points(np.zeros((1, 3))).distances(np.array([[0.0, 0.2, 0.0]])) == pytest.approx([0.2])


def wall(corner, u, v):
    """A rectangle with two triangles."""
    vertices = np.array([corner, np.add(corner, u), np.add(np.add(corner, u), v), np.add(corner, v)], float)
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


def room():
    """The walls, floor and ceiling of a room around the origin, by name."""
    x, y, z = np.diag(SIZE)
    low = -SIZE / 2
    return {
        "left": wall(low, y, z), "right": wall(low + x, y, z), "floor": wall(low, z, x),
        "ceiling": wall(low + y, z, x), "back": wall(low, x, y), "front": wall(low + z, x, y),
    }  # fmt: skip


def scan_of(walls, rng, noise=0.003):
    points = []
    for vertices, _ in walls:
        u, v = vertices[1] - vertices[0], vertices[3] - vertices[0]
        normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
        count = int(np.linalg.norm(np.cross(u, v)) / CELL**2 * 12)
        a, b, off = rng.uniform(size=(count, 1)), rng.uniform(size=(count, 1)), rng.normal(size=(count, 1))
        points.append(vertices[0] + a * u + b * v + noise * off * normal)
    return Scan.from_points(np.concatenate([cell_means(part) for part in points]))


def rig(count=12, seed=4):
    """Poses of the depth camera in the truth, and of the photos' camera in the reconstruction, by name."""
    rng = np.random.default_rng(seed)
    turn, shift = axis_rotation(np.array([0.0, 1.0, 0.0]), 2.5), np.array([0.03, 0.0, 0.01])
    depth, ours = {}, {}
    for k in range(count):
        P = look_at(rng.uniform(-0.3, 0.3, 3), rng.uniform(-0.8, 0.8, 3), rng.uniform(-20.0, 20.0))
        depth[f"{k:02d}"] = P
        R = turn @ P[:, :3] @ WORLD.R.T
        center = WORLD((camera_center(P) + P[:, :3].T @ shift)[None])[0]
        ours[f"{k:02d}"] = np.column_stack([R, -R @ center])
    return depth, ours


@pytest.fixture(scope="module")
def truth():
    walls = room()
    scan = scan_of([walls[name] for name in walls if name != "ceiling"], np.random.default_rng(2))
    return KinectTruth(scan, DEPTH_CAMERA, rig()[0])


def scores(truth, vertices, faces):
    """As for a reconstruction in a frame of its own."""
    surface = Surface(WORLD(vertices), faces, np.zeros((len(vertices), 3), np.uint8))
    return kinect_scores(surface, rig()[1], truth, 10_000)


def area_share(*names):
    walls = room()
    area = {
        name: np.linalg.norm(np.cross(v[1] - v[0], v[3] - v[0])) for name, (v, _) in walls.items() if name != "ceiling"
    }
    return 100.0 * sum(area[name] for name in names) / sum(area.values())


@pytest.mark.parametrize(
    ("moved", "accurate", "complete"), [(0.02, True, True), (0.04, False, True), (0.07, False, False)]
)
def test_walls_that_are_moved_count_by_the_limits_and_icp_moves_them_back(truth, moved, accurate, complete):
    walls = room()
    vertices, faces = joined(*(walls[name] for name in walls if name != "ceiling"))
    found = scores(truth, vertices + np.array([moved, 0.0, 0.0]), faces)
    moved_area = area_share("left", "right")
    # floor, back and front stay in their planes; only strips of the width of the shift leave the room
    assert found["accuracy 3 cm %"] == pytest.approx(100 if accurate else 100 - moved_area, abs=2.5)
    # points on the moved walls have mesh near them only where other walls meet them
    alone = np.abs(np.abs(truth.scan.points[:, 0]) - SIZE[0] / 2) < 0.02
    corner = ((np.abs(truth.scan.points) > SIZE / 2 - 0.05) & [False, True, True])[alone].any(axis=1).mean()
    missing = 100 * alone.mean() * (1 - corner / 2)
    assert found["completeness 5 cm %"] == pytest.approx(100 if complete else 100 - missing, abs=4)
    assert found["ICP: accuracy 3 cm %"] > 98.5
    assert found["ICP: moved by cm"] == pytest.approx(100 * moved, abs=0.25)


def test_a_larger_room_is_scaled_back_by_icp(truth):
    walls = room()
    vertices, faces = joined(*(walls[name] for name in walls if name != "ceiling"))
    found = scores(truth, 1.03 * vertices, faces)
    assert found["ICP: scaled by %"] == pytest.approx(-2.91, abs=0.25)
    assert 2.1 < found["median cm"] < 2.4 and found["ICP: median cm"] < 0.3, "3 % of half of the room's depth"


def test_what_is_missing_costs_completeness_and_what_is_invented_accuracy(truth):
    walls = room()
    half = scores(truth, *joined(walls["left"], walls["right"], walls["floor"]))
    assert half["accuracy 3 cm %"] > 99
    x, y, _ = truth.scan.points.T
    there = (np.abs(x) > SIZE[0] / 2 - 0.05) | (y < -SIZE[1] / 2 + 0.05)
    assert half["completeness 5 cm %"] == pytest.approx(100 * there.mean(), abs=0.5) and 50 < 100 * there.mean() < 85
    more = scores(truth, *joined(*walls.values()))
    whole = 2 * (SIZE[0] * SIZE[1] + SIZE[1] * SIZE[2] + SIZE[0] * SIZE[2])
    ceiling, inner = 100 * SIZE[0] * SIZE[2] / whole, 100 * (SIZE[0] - 0.2) * (SIZE[2] - 0.2) / whole
    assert more["accuracy 3 cm %"] == pytest.approx(100 - ceiling, abs=2.0), "a hole of the scan counts"
    assert more["over 10 cm off %"] == pytest.approx(inner, abs=1.0) and more["completeness 5 cm %"] == 100
    empty = np.zeros((0, 3))
    assert scores(truth, empty, np.zeros((0, 3), np.int64)) == {}


def test_reach_is_the_picture_the_range_and_what_nothing_hides():
    truth = KinectTruth(Scan.from_points(np.zeros((1, 3))), DEPTH_CAMERA, {"a": np.eye(4)[:3]})
    sheet = Surface(*wall((-0.5, -0.5, 2.0), (1, 0, 0), (0, 1, 0)), np.zeros((4, 3), np.uint8))
    places = np.array(
        [[0, 0, 0.39], [0, 0, 0.41], [0, 0, 2.0], [0, 0, 2.01], [0, 0, 2.1], [0, 0, -2], [1.0, 0.0, 3.4], [1, 0, 3.6],
         [0.54, 0, 1.0], [0.56, 0, 1.0]], float,
    )  # fmt: skip
    assert within_reach(places, sheet, truth, ["a", "unknown"]).tolist() == [
        False, True, True, True, False, False, True, False, True, False,
    ]  # fmt: skip


@pytest.mark.parametrize("pivot", [0.8, 2.0])
def test_cameras_that_are_turned_about_what_they_see_are_told(pivot):
    depth, ours = rig(40)
    same = compare_cameras(ours, depth, WORLD.inverse())
    assert same.offset == pytest.approx([0.03, 0.0, 0.01], abs=1e-6) and same.turn_deg.max() < 1e-4
    rng = np.random.default_rng(5)
    turned = {}
    for name, P in depth.items():
        R = axis_rotation(np.eye(3)[0], rng.normal()) @ axis_rotation(np.eye(3)[1], rng.normal())
        # the point ahead stays where it is in the picture
        t = R @ (P[:, 3] - [0.0, 0.0, pivot]) + [0.0, 0.0, pivot]
        turned[name] = np.column_stack([R @ P[:, :3], t + 0.001 * rng.normal(size=3)])
    found = compare_cameras(ours, turned, WORLD.inverse())
    assert found.pivot_m == pytest.approx(pivot, abs=0.05) and 0.97 < found.explained < 1.0
    assert 0.8 < np.median(found.turn_deg) < 1.7
    shifted = {n: P + np.column_stack([np.zeros((3, 3)), 0.03 * rng.normal(size=3)]) for n, P in depth.items()}
    assert abs(compare_cameras(ours, shifted, WORLD.inverse()).explained) < 0.2, "a shift is no turn"


def test_icp_wants_something_near():
    scan, _ = plane_scan(0.0, np.random.default_rng(0))
    with pytest.raises(ValueError, match="0 samples"):
        align(np.full((500, 3), 4.0), scan)


def test_a_scanned_set_is_every_fifth_photo_and_has_its_bars(tmp_path):
    import open3d

    folder = tmp_path / "data" / "kitchen1000"
    (folder / "images").mkdir(parents=True)
    poses, _ = rig(12)
    entries = []
    for k, P in enumerate(poses.values()):
        Image.new("RGB", (8, 6)).save(folder / "images" / f"{k:06d}.jpg")
        entry = {"file": f"{k:06d}.jpg", "width": 640, "height": 480, "K": [[525, 0, 320], [0, 525, 240], [0, 0, 1]]}
        entries.append(entry | {"R": P[:, :3].tolist(), "t": P[:, 3].tolist()})
    (folder / "cameras.json").write_text(json.dumps({"images": entries}), encoding="utf-8")
    points = np.random.default_rng(0).uniform(size=(50, 3))
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    open3d.io.write_point_cloud(str(folder / "surface.ply"), cloud)
    chosen = surface_set("kitchen1000", tmp_path / "data", tmp_path)
    assert [path.stem for path in sorted(chosen.photos.iterdir())] == ["000000", "000005", "000010"]
    assert np.allclose(chosen.kinect.scan.points, points, atol=1e-6)
    assert np.allclose(chosen.kinect.poses["000005"], poses["05"])
    assert surface_set("kitchen1000 every:6", tmp_path / "data", tmp_path).count == 2
    assert load_kinect(folder).camera.K[0, 0] == FOCAL_PX
    assert set(SCANNED) <= set(BARS)
    judged = bar_rows([{"photos": "kitchen1000", "accuracy 3 cm %": 80.0, "completeness 5 cm %": 69.9}])
    assert [row["met"] for row in judged] == ["yes", "**no**"]
