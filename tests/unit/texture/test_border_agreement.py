"""Borders about which photos disagree: a sheet of 40 x 40 squares in four photos."""

import numpy as np
import pytest
from painted_box import sightings

from sfm_app.geometry.triangles import select_faces
from sfm_app.texture.appearance import CRUMBS, RINGS, doubtful_border
from sfm_app.texture.facets import facets
from sfm_app.types import Surface

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
    """Gray levels in the photos, which differ by up to `by` where `off` is True."""
    shown = 100.0 + np.random.default_rng(0).normal(0, noise, (PHOTOS, len(CENTER), 3))
    shown[:, off] += by * np.linspace(-0.5, 0.5, PHOTOS)[:, None, None]
    return np.round(shown * GAINS[:, None]).clip(0, 255).astype(np.uint8)


def cut(off, by, worth=EVERYWHERE, noise=1.0):
    return doubtful_border(sightings(worth, colors(off, by, noise)), GAINS, MESH.neighbors)


def test_what_photos_disagree_about_is_cut_where_it_borders():
    flake = (CENTER[:, 0] < 4) & (CENTER[:, 1] > 10) & (CENTER[:, 1] < 20)
    found = cut(flake, 80.0)
    assert found[flake].all()
    assert found.sum() < 1.4 * flake.sum()


@pytest.mark.parametrize(("by", "noise"), [(0.0, 1.0), (12.0, 1.0), (24.0, 0.0)])
def test_noise_and_small_differences_cut_nothing(by, noise):
    """Photos without noise agree exactly, but ten gray levels are no doubt."""
    assert not cut(CENTER[:, 0] < 4, by, noise=noise).any()


def test_few_spikes_stay():
    """The widths of the flake differ from row to row; without straightening, 25 triangles stand out."""
    width = np.random.default_rng(3).integers(1, 8, SIDE)[CENTER[:, 1].astype(int)]
    found = cut(CENTER[:, 0] < width, 120.0)
    beside = (MESH.neighbors >= 0) & found[MESH.neighbors]
    open_sides = (beside | (MESH.neighbors < 0)).sum(axis=1)
    assert 100 < found.sum() < 1000
    assert (~found & beside.any(axis=1) & (open_sides >= 2)).sum() < 6


def test_what_differs_as_much_everywhere_stays():
    """Photos of a day with clouds: what is usual is no doubt."""
    assert not cut(np.ones(len(CENTER), bool), 80.0).any()


def test_what_does_not_touch_the_border_stays():
    assert not cut(np.abs(CENTER[:, :2] - SIDE / 2).max(axis=1) < 8, 80.0).any()


def test_no_more_than_some_rings_are_cut():
    found = cut(CENTER[:, 0] < 0.4 * SIDE, 80.0) & (np.abs(CENTER[:, 1] - SIDE / 2) < 5)
    assert RINGS / 2 - 1 < CENTER[found, 0].max() < RINGS / 2 + 2  # two triangles lie across each square


def test_a_passer_by_cuts_nothing():
    """One of four photos shows it; the rest agree."""
    worth, shown, person = EVERYWHERE.copy(), colors(), CENTER[:, 0] < 4
    worth[2, person], shown[2, person] = -1.0, 200
    assert not doubtful_border(sightings(worth, shown), GAINS, MESH.neighbors).any()
    worth[2, person] = 1.0
    assert doubtful_border(sightings(worth, shown), GAINS, MESH.neighbors)[person].mean() > 0.9


def test_two_that_differ_cut():
    """Where half of the photos show other things, they are not all people."""
    worth, shown, flake = EVERYWHERE.copy(), colors(), CENTER[:, 0] < 4
    worth[2:, flake], shown[2, flake], shown[3, flake] = -1.0, 200, 10
    assert doubtful_border(sightings(worth, shown), GAINS, MESH.neighbors)[flake].mean() > 0.9


def test_one_photo_alone_decides_nothing():
    worth = EVERYWHERE.copy()
    worth[1:] = 0.0
    assert not cut(CENTER[:, 0] < 4, 80.0, worth).any()


def test_crumbs_go_with_the_border_that_held_them():
    crumb = (CENTER[:, 0] < 1) & (np.abs(CENTER[:, 1] - 20) < 1)
    assert 0 < crumb.sum() < CRUMBS
    wide = (CENTER[:, 0] < 6) & (np.abs(CENTER[:, 1] - 20) < 6)
    assert cut(wide & ~crumb, 160.0)[crumb].all()


def test_a_part_without_a_cut_stays_however_small():
    apart = (CENTER[:, 0] > 37) | ((CENTER[:, 0] < 1) & (CENTER[:, 1] < 1))
    mesh = facets(select_faces(MESH.surface, apart | (np.abs(CENTER[:, 0] - 20) < 10)))
    worth = np.ones((PHOTOS, len(mesh.faces)))
    shown = np.full((*worth.shape, 3), 100, np.uint8)
    shown[:, mesh.vertices[mesh.faces].mean(axis=1)[:, 0] > 38] += np.array([0, 30, 60, 90], np.uint8)[:, None, None]
    found = doubtful_border(sightings(worth, shown), np.ones((PHOTOS, 3)), mesh.neighbors)
    at = mesh.vertices[mesh.faces].mean(axis=1)[:, 0]
    assert found[at > 38].any()
    assert not found[at < 30].any()
