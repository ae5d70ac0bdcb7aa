"""Gains of photos, outlier views, and doubtful borders of a sheet of 40 x 40 squares in four photos."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from painted_box import box, sightings

from sfm_app.geometry.triangles import select_faces
from sfm_app.texture.appearance import BORDERS, doubtful_border, median, outlier_mask, photo_gains
from sfm_app.texture.sightings import facets
from sfm_app.types import Surface


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=12))
@settings(deadline=None)
def test_median_is_numpys(values):
    assert median(np.array([*values, 7.0, -7.0]), len(values)) == pytest.approx(np.median(values))


@pytest.mark.parametrize("strays", [0.0, 0.2])
def test_gains_are_robust_to_noise_and_outliers(strays):
    rng = np.random.default_rng(3)
    truth = rng.uniform(0.6, 1.4, (6, 3))
    truth /= np.exp(np.log(truth).mean(axis=0))
    albedo = rng.uniform(40, 150, (3000, 3))
    colors = albedo * truth[:, None, :] * rng.normal(1.0, 0.03, (6, 3000, 3))
    wrong = rng.random((6, 3000)) < strays
    colors[wrong] = rng.uniform(0, 255, (wrong.sum(), 3))
    first = np.arange(3000) * 5 // 3000  # a chain: each triangle is seen by two photos next to each other
    seen = np.zeros((6, 3000), bool)
    seen[first, np.arange(3000)] = seen[first + 1, np.arange(3000)] = True
    found = photo_gains(sightings(seen, np.clip(colors, 0, 255).astype(np.uint8)))
    np.testing.assert_allclose(found, truth, rtol=0.08 if strays else 0.03)


def test_photos_without_common_triangles_keep_their_exposure():
    colors = np.full((3, 100, 3), 100, np.uint8)
    colors[2] = 200
    seen = np.zeros((3, 100), bool)
    seen[:2, :50] = seen[2, 50:] = True
    np.testing.assert_allclose(photo_gains(sightings(seen, colors)), 1.0)


def test_outliers_are_areas_not_specks():
    mesh = facets(box(16))
    rng = np.random.default_rng(5)
    count = len(mesh.faces)
    colors = (120 + rng.normal(0, 5, (4, count, 3))).astype(np.uint8)
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    person = np.linalg.norm(centers - [1.0, 0.1, 0.1], axis=1) < 0.35
    colors[2, person] = (20, 160, 220)
    speck = int(np.argmax(centers[:, 1]))
    colors[1, speck] = 200
    seen = np.ones((4, count), bool)
    found = outlier_mask(sightings(seen, colors), np.ones((4, 3)), mesh.neighbors).reshape(seen.shape)
    assert found[2, person].all()
    assert 0 < found[2].sum() - person.sum() < 0.6 * person.sum()  # a rim around it, no more
    assert not found[[0, 1, 3]].any()
    two = outlier_mask(sightings(seen[:2], colors[1:3]), np.ones((2, 3)), mesh.neighbors)
    assert not two.any()


# Doubtful borders.

SIDE, PHOTOS = 40, 4
GAINS = np.array([1.0, 0.5, 1.2, 0.8])[:, None] * np.ones(3)


def sheet():
    x, y = (part.ravel() for part in np.meshgrid(np.arange(SIDE + 1.0), np.arange(SIDE + 1.0)))
    corner = (np.arange(SIDE)[:, None] * (SIDE + 1) + np.arange(SIDE)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, SIDE + 2], corner[:, None] + [0, SIDE + 2, SIDE + 1]])
    return Surface(np.column_stack([x, y, 0 * x]), faces, np.zeros((len(x), 3), np.uint8))


MESH = facets(sheet())
CENTER = MESH.vertices[MESH.faces].mean(axis=1)
EVERYWHERE = np.ones((PHOTOS, len(CENTER)))


def colors(off=(), by=0.0, noise=1.0):
    """Gray levels in the photos; they differ by up to `by` at triangles `off`."""
    gray = 100.0 + np.random.default_rng(0).normal(0, noise, (PHOTOS, len(CENTER), 3))
    gray[:, off] += by * np.linspace(-0.5, 0.5, PHOTOS)[:, None, None]
    return np.round(gray * GAINS[:, None]).clip(0, 255).astype(np.uint8)


def cut(off, by, score=EVERYWHERE, noise=1.0):
    return doubtful_border(sightings(score, colors(off, by, noise)), GAINS, MESH.neighbors)


def test_a_doubtful_flake_at_the_border_is_cut():
    flake = (CENTER[:, 0] < 4) & (CENTER[:, 1] > 10) & (CENTER[:, 1] < 20)
    mask = cut(flake, 80.0)
    assert mask[flake].all()
    assert mask.sum() < 1.4 * flake.sum()


@pytest.mark.parametrize(("by", "noise"), [(0.0, 1.0), (12.0, 1.0), (24.0, 0.0)])
def test_noise_and_small_differences_cut_nothing(by, noise):
    """Photos without noise agree exactly, but ten gray levels are no disagreement."""
    assert not cut(CENTER[:, 0] < 4, by, noise=noise).any()


def test_few_spikes_stay():
    """The widths of the flake differ from row to row; without straightening, 25 triangles stand out."""
    width = np.random.default_rng(3).integers(1, 8, SIDE)[CENTER[:, 1].astype(int)]
    found = cut(CENTER[:, 0] < width, 120.0)
    beside = (MESH.neighbors >= 0) & found[MESH.neighbors]
    open_sides = (beside | (MESH.neighbors < 0)).sum(axis=1)
    assert 100 < found.sum() < 1000
    assert (~found & beside.any(axis=1) & (open_sides >= 2)).sum() < 6


def test_a_common_disagreement_and_an_inner_one_stay():
    """Photos of a day with clouds disagree everywhere."""
    assert not cut(np.ones(len(CENTER), bool), 80.0).any()
    assert not cut(np.abs(CENTER[:, :2] - SIDE / 2).max(axis=1) < 8, 80.0).any()


def test_few_rings_are_cut():
    found = cut(CENTER[:, 0] < 0.4 * SIDE, 80.0) & (np.abs(CENTER[:, 1] - SIDE / 2) < 5)
    assert (
        BORDERS.rings / 2 - 1 < CENTER[found, 0].max() < BORDERS.rings / 2 + 2
    )  # two triangles lie across each square


def test_one_outlier_is_a_passer_by_and_two_are_a_disagreement():
    score, gray, flake = EVERYWHERE.copy(), colors(), CENTER[:, 0] < 4
    score[2, flake], gray[2, flake] = -1.0, 200
    assert not doubtful_border(sightings(score, gray), GAINS, MESH.neighbors).any()
    score[2, flake] = 1.0
    assert doubtful_border(sightings(score, gray), GAINS, MESH.neighbors)[flake].mean() > 0.9
    score[2:, flake], gray[3, flake] = -1.0, 10
    assert doubtful_border(sightings(score, gray), GAINS, MESH.neighbors)[flake].mean() > 0.9


def test_one_photo_alone_decides_nothing():
    score = EVERYWHERE.copy()
    score[1:] = 0.0
    assert not cut(CENTER[:, 0] < 4, 80.0, score).any()


def test_crumbs_beside_a_cut_are_cut():
    crumb = (CENTER[:, 0] < 1) & (np.abs(CENTER[:, 1] - 20) < 1)
    assert 0 < crumb.sum() < BORDERS.crumbs
    wide = (CENTER[:, 0] < 6) & (np.abs(CENTER[:, 1] - 20) < 6)
    assert cut(wide & ~crumb, 160.0)[crumb].all()


def test_a_small_part_without_a_cut_stays():
    apart = (CENTER[:, 0] > 37) | ((CENTER[:, 0] < 1) & (CENTER[:, 1] < 1))
    mesh = facets(select_faces(MESH.surface, apart | (np.abs(CENTER[:, 0] - 20) < 10)))
    score = np.ones((PHOTOS, len(mesh.faces)))
    gray, at = np.full((*score.shape, 3), 100, np.uint8), mesh.vertices[mesh.faces].mean(axis=1)[:, 0]
    gray[:, at > 38] += np.array([0, 30, 60, 90], np.uint8)[:, None, None]
    mask = doubtful_border(sightings(score, gray), np.ones((PHOTOS, 3)), mesh.neighbors)
    assert mask[at > 38].any()
    assert not mask[at < 30].any()
