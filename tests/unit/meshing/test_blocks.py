"""Blocks of points, and surfaces that are joined at the planes between them without a seam."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sfm_app.geometry.triangles import unique_edges, vertex_normals
from sfm_app.meshing.blocks import close_cracks, cut_at_plane, split_points, weld
from sfm_app.meshing.cleaning import make_manifold
from sfm_app.synthetic.shapes import grid
from sfm_app.types import Surface

CELL, HALO = 0.07, 0.56


def ball(seed, noise=0.1):
    """The unit ball, with other triangles and other noise (in cells) for every seed."""
    mesh = trimesh.creation.icosphere(subdivisions=4)
    rng = np.random.default_rng(seed)
    radius = 1 + noise * CELL * rng.normal(size=(len(mesh.vertices), 1))
    vertices = radius * (mesh.vertices @ Rotation.random(rng=seed).as_matrix().T)
    return Surface(vertices, np.asarray(mesh.faces, np.int64), np.zeros((len(vertices), 3), np.uint8))


def sheet(seed, noise=0.2, size=40):
    """A rough plane z = 0 with cells of size 1."""
    rng = np.random.default_rng(seed)
    places, faces = grid(np.arange(size + 1.0), np.arange(size + 1.0))
    vertices = np.column_stack([places, np.zeros(len(places))]) + rng.normal(size=(len(places), 3)) * [0.2, 0.2, noise]
    return Surface(vertices, faces, np.zeros((len(vertices), 3), np.uint8))


def four(make, first, second, cell, halo):
    """2 x 2 x 1 blocks."""
    left, _ = weld(make(1), make(2), 1, second, cell, halo)
    right, _ = weld(make(3), make(4), 1, second + 0.3 * cell, cell, halo)
    found = weld(left, right, 0, first, cell, halo)[0]
    return close_cracks(found, (np.abs(found.vertices[:, :2] - [first, second]) < 2 * cell).any(axis=1))


def open_edges(surface):
    edges, edge_of = unique_edges(surface.faces)
    return edges[np.bincount(edge_of.ravel()) == 1]


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3])
def test_a_ball_in_four_blocks_is_closed_and_round(noise):
    found = four(lambda seed: ball(seed, noise), 0.013, -0.021, CELL, HALO)

    edges, _ = unique_edges(found.faces)
    assert len(open_edges(found)) == 0
    assert len(found.vertices) - len(edges) + len(found.faces) == 2
    volume = np.sum(np.linalg.det(found.vertices[found.faces])) / 6
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.01)
    off = np.abs(np.linalg.norm(found.vertices, axis=1) - 1)
    assert off.max() < (0.05 + 5 * noise) * CELL


def test_a_crack_without_area_is_closed():
    """Two planes that nearly touch leave two vertices in one place, with flat triangles between them."""
    whole = ball(1, noise=0.0)
    around = np.flatnonzero((whole.faces == 0).any(axis=1))
    fan = {}  # from one neighbor of vertex 0 to the next
    for face in whole.faces[around]:
        at = int(np.flatnonzero(face == 0)[0])
        fan[int(face[(at + 1) % 3])] = int(face[(at + 2) % 3])
    first = min(fan)
    second = fan[fan[first]]
    twin = len(whole.vertices)
    faces = whole.faces.copy()
    for face in around:
        corners = faces[face].tolist()
        if corners[(corners.index(0) + 1) % 3] in (first, fan[first]):
            faces[face][corners.index(0)] = twin
    faces = np.concatenate([faces, [[0, twin, first], [twin, 0, second]]])
    torn = Surface(np.concatenate([whole.vertices, whole.vertices[:1]]), faces, np.zeros((twin + 1, 3), np.uint8))
    assert len(open_edges(torn)) == 0 and len(open_edges(make_manifold(torn))) == 4

    found = close_cracks(torn, np.ones(twin + 1, bool))

    assert len(open_edges(found)) == 0
    assert (len(found.vertices), len(found.faces)) == (len(whole.vertices), len(whole.faces))


def test_normals_at_the_planes_are_those_beside_them():
    found = four(lambda seed: ball(seed, 0.02), 0.013, -0.021, CELL, HALO)
    normals = vertex_normals(found.vertices, found.faces)
    cosine = np.sum(normals * found.vertices, axis=1) / np.linalg.norm(found.vertices, axis=1)
    near = (np.abs(found.vertices[:, :2] - [0.013, -0.021]) < 1.5 * CELL).any(axis=1)

    assert np.degrees(np.arccos(np.quantile(cosine[near], 0.01))) < 8.0
    assert np.degrees(np.arccos(np.quantile(cosine[~near], 0.01))) > 1.0  # the noise itself


def test_a_rough_plane_has_no_step_where_blocks_meet():
    found = four(sheet, 20.3, 18.7, 1.0, 8.0)

    rim = np.abs(found.vertices - [20, 20, 0])[:, :2].max(axis=1) > 18.0
    border = np.zeros(len(rim), bool)
    border[open_edges(found).ravel()] = True
    assert not border[~rim].any()
    x, y, z = found.vertices[~rim].T
    sides = [z[(np.abs(x - 20.3 - d) < 1.5) & (np.abs(y - 20) < 15)].mean() for d in (-1.6, 1.6)]
    assert abs(sides[1] - sides[0]) < 0.1
    assert 0.1 < z.std() < 0.25


def test_a_shifted_half_is_pulled_to_the_other_one():
    """A step of a cell becomes a slope over the halo."""
    one, other = sheet(1, noise=0.0), sheet(2, noise=0.0)
    other.vertices[:, 2] += 1.0

    found = weld(one, other, 0, 20.3, 1.0, 8.0)[0]

    x, y, z = found.vertices.T
    inner = np.abs(y - 20) < 15
    np.testing.assert_allclose(z[inner & (x <= 20.3)], 0.0, atol=1e-9)
    slope = inner & (x > 20.3) & (x < 28.3)
    np.testing.assert_allclose(z[slope], (x[slope] - 20.3) / 8.0, atol=0.15)
    np.testing.assert_allclose(z[inner & (x > 29.5)], 1.0, atol=1e-9)


def test_what_only_one_side_has_stays_open():
    nothing = Surface(np.empty((0, 3)), np.empty((0, 3), np.int64), np.empty((0, 3), np.uint8))

    found, lost = weld(ball(1), nothing, 0, 0.01, CELL, HALO)

    assert lost == len(open_edges(found)) > 50
    assert found.vertices[:, 0].max() == 0.01


def test_two_sheets_of_a_thin_wall_keep_apart():
    """The nearest border is that of the other sheet, which runs the other way."""

    def wall(seed):
        front, back = sheet(seed, 0.02), sheet(seed + 10, 0.02)
        faces = np.concatenate([front.faces, back.faces[:, ::-1] + len(front.vertices)])
        vertices = np.concatenate([front.vertices, back.vertices - [0, 0, 0.4]])
        return Surface(vertices, faces, np.zeros((len(vertices), 3), np.uint8))

    one, other = wall(1), wall(2)
    other.vertices[:, 2] += 0.25
    found = make_manifold(weld(one, other, 0, 20.3, 1.0, 8.0)[0])

    z = found.vertices[np.abs(found.vertices[:, 0] - 20.3) < 1e-9, 2]
    assert np.minimum(np.abs(z), np.abs(z + 0.4)).max() < 0.1


def test_a_cut_lies_in_its_plane():
    found, border = cut_at_plane(ball(3), 2, 0.2, keep_below=True)

    assert found.vertices[:, 2].max() == 0.2
    assert (found.vertices[border.ends, 2] == 0.2).all()
    assert len(border.ends) == len(open_edges(found))


@pytest.mark.parametrize("blocks", [1, 2, 3, 7, 16])
def test_every_point_is_in_one_block_and_blocks_are_as_large(blocks):
    points = np.random.default_rng(blocks).normal(size=(20_000, 3)) * [30, 20, 2]

    partition = split_points(points, blocks)

    numbers = partition.find_blocks(points)
    low, high = np.moveaxis(partition.boxes[numbers], 1, 0)
    sizes = np.bincount(numbers, minlength=blocks)
    assert len(partition.boxes) == len(sizes) == blocks
    assert ((points >= low) & (points < high)).all()
    assert 0.8 < sizes.min() * blocks / len(points) <= 1.0
    assert sizes.max() * blocks / len(points) < 1.2


def test_blocks_are_cut_across_their_longest_side():
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3)) * [50, 20, 1]

    partition = split_points(points, 4)

    assert np.isinf(partition.boxes[:, :, 2]).all()
