"""Outlines of a disc before a wall, or before nothing, whose depth spills over its outline or ends before it."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.stereo import DepthMap, View
from sfm_app.stereo.outlines import AROUND_PX, REACH_PX, sharpen_outlines

RADIUS = 0.45
CENTERS = [(-0.3, 0, 0), (0, 0, 0), (0.3, 0.05, 0), (0.05, 0.3, 0.05)]


def grain(mean, spread, seed):
    """A texture of grains three pixels wide; `spread` is the standard deviation of its gray levels."""
    grains = np.random.default_rng(seed).normal(mean, spread, (700, 700)).astype(np.float32)
    return np.clip(cv2.resize(grains, (2000, 2000), interpolation=cv2.INTER_CUBIC), 0, 255).astype(np.uint8)


@dataclass
class Scene:
    """A disc, which faces the cameras, before a wall; `is_open` takes the depths of the wall away."""

    disc: object
    wall: object
    is_open: bool = False

    def on_disc(self, view, grow=0.0):
        """(H, W) whether pixels show the disc, whose radius is `grow` pixels larger."""
        points = self.disc._rays(view, 0.5) * self.disc.depth(view)[..., None] + view.center
        return np.hypot(points[..., 0], points[..., 1]) < RADIUS + grow * self.disc.distance / view.K[0, 0]

    def photo(self, view):
        return np.where(self.on_disc(view), self.disc.photo(view), self.wall.photo(view))

    def maps(self, view, grow=0.0):
        """Depth map of a disc whose radius is `grow` pixels larger."""
        on_disc = self.on_disc(view, grow)
        wall = np.float32(0) if self.is_open else self.wall.depth(view)
        normals = np.where(on_disc[..., None], -self.disc.normal, -self.wall.normal)
        depth = np.where(on_disc, self.disc.depth(view), wall)
        return DepthMap(depth, np.where(depth[..., None] > 0, normals, 0).astype(np.float32))

    def sharpen(self, view, maps, views):
        return sharpen_outlines(maps, view, self.photo(view), [(one, self.photo(one)) for one in views])


@pytest.fixture(scope="module")
def views(make_view):
    return [make_view(center, name=f"{i}.jpg") for i, center in enumerate(CENTERS)]


@pytest.fixture
def scene(plane):
    def make(disc=(128, 40), wall=(128, 40), *, is_open=False):
        facing = replace(plane, normal=np.array([0.0, 0.0, 1.0]), distance=2.0, texture=grain(*disc, 1))
        return Scene(facing, replace(plane, texture=grain(*wall, 2)), is_open)

    return make


def right(found, true):
    """(H, W) whether depths are those of the right surface."""
    return np.where(true > 0, np.abs(found - true) < 0.02 * np.maximum(true, 0.1), found == 0)


TEXTURES = [((128, 40), (128, 40)), ((60, 4), (200, 2)), ((60, 4), (150, 40)), ((150, 40), (60, 2))]


@pytest.mark.parametrize(("disc", "wall"), TEXTURES)
def test_depths_that_cross_an_outline_return_to_their_surface(scene, views, disc, wall):
    one, view = scene(disc, wall), views[1]
    true, given_maps = one.maps(view), one.maps(view, 4)
    crossed = ~right(given_maps.depth, true.depth)
    assert crossed.sum() > 500

    found = one.sharpen(view, given_maps, views[:1] + views[2:])

    assert np.mean(right(found.depth, true.depth)[crossed]) > 0.9
    assert np.mean(right(found.depth, true.depth)[~crossed]) > 0.99
    cosine = (found.normals * true.normals).sum(axis=2)[crossed & right(found.depth, true.depth)]
    assert cosine.min() > 0.99


@pytest.mark.parametrize("sample_px", [0.0, 0.5])
def test_unknown_depths_at_an_outline_are_filled(scene, make_view, views, sample_px):
    one, view = scene(), make_view(CENTERS[1], sample_px=sample_px)
    true = one.maps(view)
    ring = one.on_disc(view, 2) & ~one.on_disc(view, -2)
    torn = DepthMap(np.where(ring, 0, true.depth), np.where(ring[..., None], 0, true.normals))

    found = one.sharpen(view, torn, views[:1] + views[2:])

    sure = ring & right(found.depth, true.depth)
    assert np.mean(found.depth[ring] > 0) > 0.85
    assert np.mean(sure[ring & (found.depth > 0)]) > 0.9
    assert np.abs(found.depth / true.depth - 1)[sure].max() < 1e-3


@pytest.mark.parametrize(("disc", "wall"), [((120, 2), (200, 2)), ((60, 15), (10, 2)), ((60, 10), (160, 6))])
def test_depths_over_nothing_end_at_the_outline(scene, views, disc, wall):
    one, view = scene(disc, wall, is_open=True), views[1]
    on_disc, given_maps = one.on_disc(view), one.maps(view, 4)

    found = one.sharpen(view, given_maps, views[2:])

    assert np.mean(found.depth[given_maps.depth > 0][~on_disc[given_maps.depth > 0]] == 0) > 0.9
    assert np.mean(found.depth[on_disc] > 0) > 0.98
    assert not found.normals[found.depth == 0].any()


def test_a_gap_with_texture_is_not_nothing(scene, views):
    """Matching has failed there: the surface beside it stays, though its grays are like those of the gap."""
    one, view = scene((120, 40), (120, 40), is_open=True), views[1]
    given_maps = one.maps(view)

    found = one.sharpen(view, given_maps, views[2:])

    assert np.mean((found.depth > 0)[given_maps.depth > 0]) > 0.99


def test_an_outline_between_equal_grays_stays(scene, views):
    one = scene((150, 2), (150, 2))
    given_maps = one.maps(views[1], 3)

    found = one.sharpen(views[1], given_maps, views[2:])

    assert np.mean(found.depth == given_maps.depth) > 0.985


def test_a_wire_unlike_the_background_stays(scene, views):
    one, view = scene((200, 2), (200, 2), is_open=True), views[1]
    depth = one.disc.depth(view)
    col = np.indices(depth.shape)[1]
    wire, seam = np.abs(col - 117) <= 1, np.abs(col - 117) < REACH_PX
    image = np.where(wire, 120, one.photo(view)).astype(np.uint8)
    normals = np.where(seam[..., None], -one.disc.normal, 0).astype(np.float32)

    found = sharpen_outlines(
        DepthMap(np.where(seam, depth, 0), normals), view, image, [(views[2], one.photo(views[2]))]
    )

    inner = (slice(AROUND_PX, -AROUND_PX), slice(AROUND_PX, -AROUND_PX))
    assert (found.depth[inner][wire[inner]] > 0).all()
    assert np.mean(found.depth[inner][(seam & ~wire)[inner]] > 0) < 0.1


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_only_pixels_within_reach_of_an_outline_change(plane, views, seed, share):
    rng, view = np.random.default_rng(seed), views[1]
    squares = rng.random((view.height // 20 + 1, view.width // 20 + 1)) < share
    near = np.repeat(np.repeat(squares, 20, 0), 20, 1)[: view.height, : view.width]
    depth = (np.where(near, 0.5, 1) * plane.depth(view)).astype(np.float32)
    normals = np.broadcast_to(-plane.normal, (*depth.shape, 3)).astype(np.float32)
    image = rng.integers(0, 256, depth.shape).astype(np.uint8)

    found = sharpen_outlines(DepthMap(depth, normals), view, image, [(views[0], image)])

    far = cv2.distanceTransform((~near).astype(np.uint8), cv2.DIST_L2, 5)
    far = np.maximum(far, cv2.distanceTransform(near.astype(np.uint8), cv2.DIST_L2, 5))
    np.testing.assert_array_equal(found.depth[far > REACH_PX + 1], depth[far > REACH_PX + 1])


@pytest.mark.parametrize("slope", [0.0, 0.008])
def test_a_plane_stays(views, slope):
    view: View = views[1]
    q = np.broadcast_to(0.4 * (1 - slope * (np.arange(view.width) - 120)), (view.height, view.width))
    normal = np.array([-slope * 0.4 * 230, 0, 1 - slope * (117 - 120)])
    depth = np.divide(1, q, out=np.zeros(q.shape, np.float32), where=q > 0.05)
    normals = np.where(depth[..., None] > 0, -normal / np.linalg.norm(normal), 0).astype(np.float32)
    image = np.random.default_rng(0).integers(0, 256, depth.shape).astype(np.uint8)

    found = sharpen_outlines(DepthMap(depth, normals), view, image, [(views[0], image)])

    np.testing.assert_array_equal(found.depth[:, : view.width // 2], depth[:, : view.width // 2])
