"""The photo of each triangle."""

import itertools

import numpy as np
import pytest
from painted_box import sightings, strip

from sfm_app.texture.sightings import NONE
from sfm_app.texture.view_selection import OPTIONS, choose_photos


def energy(chosen, score, mesh):
    lost = np.log(score.max(axis=0) / score[chosen, np.arange(len(chosen))])
    size = np.sqrt(0.5 / (np.sqrt(3) / 4 * mesh.spacing**2))
    corners = mesh.vertices[mesh.faces]
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2) / mesh.spacing
    beside = mesh.neighbors
    cut = (beside != NONE) & (chosen[beside] != chosen[:, None])
    return OPTIONS.price_of_detail * size * np.minimum(lost, 3.0).sum() + (lengths * cut).sum() / 2


@pytest.mark.parametrize("seed", range(6))
def test_labels_are_the_cheapest_of_all(seed):
    mesh = strip(3)
    score = np.exp(np.random.default_rng(seed).normal(0, 4, (3, 6))).astype(np.float32)
    least = min(energy(np.array(labels), score, mesh) for labels in itertools.product(range(3), repeat=6))
    found = choose_photos(sightings(score), mesh)
    assert energy(found, score, mesh) == pytest.approx(least, abs=1e-4)


def test_photos_that_must_not_be_used_are_not():
    mesh = strip(4)
    score = np.full((2, 8), 5.0, np.float32)
    score[0, :3] = 0.0
    score[1, :2] = -9.0
    found = choose_photos(sightings(score), mesh)
    assert (found[:2] == NONE).all()
    assert found[2] == 1
    assert (found[3:] != NONE).all()
