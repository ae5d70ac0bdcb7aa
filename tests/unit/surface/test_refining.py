"""A refinement that fails leaves the surface as it was; photos are compared with those that are there."""

import numpy as np
import pytest

from sfm_app.meshing.refinement import Refinement
from sfm_app.settings import MeshSettings
from sfm_app.stereo import View
from sfm_app.surface import refining
from sfm_app.surface.refining import PARTNERS, Originals, rank_partners, refine_surface
from sfm_app.types import Surface

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
SURFACE = Surface(CORNERS, np.array([[0, 1, 2]]), np.zeros((3, 3), np.uint8))


def make_views(count):
    """Photos side by side that see the same points."""
    points = np.random.default_rng(0).normal((0.0, 0.0, 8.0), 1.0, (50, 3))
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    return [
        View(f"{k}.jpg", K, np.column_stack([np.eye(3), [-0.6 * k, 0, 0]]), 100, 100, np.arange(50), points)
        for k in range(count)
    ]


@pytest.fixture
def asked(monkeypatch):
    """What the refinement is asked for; no photo is read."""
    found = []

    def refine(surface, photos, partners, most, spread):
        found.append(partners)
        return Refinement(surface, (0.5,))

    monkeypatch.setattr(Originals, "read", lambda *_: [])
    monkeypatch.setattr(refining, "refine", refine)
    return found


def test_only_photos_that_take_part_are_partners(asked, tmp_path):
    views = make_views(8)
    partners = rank_partners(views)

    refine_surface(SURFACE, Originals(tmp_path, tmp_path, None), views[:3], partners, MeshSettings())

    assert {name: len(names) for name, names in partners.items()} == {view.name: 2 * PARTNERS for view in views}
    assert len(asked[0]) == 3 and all(set(others) <= {0, 1, 2} - {k} for k, others in enumerate(asked[0]))
    assert sum(map(len, asked[0])) >= 3


def test_a_failure_is_a_reason(monkeypatch, tmp_path):
    def fail(*_):
        raise np.linalg.LinAlgError("no depth")

    monkeypatch.setattr(Originals, "read", lambda *_: [])
    monkeypatch.setattr(refining, "refine", fail)
    views = make_views(2)

    found = refine_surface(SURFACE, Originals(tmp_path, tmp_path, None), views, rank_partners(views), MeshSettings())

    assert found.surface is SURFACE and found.failed == "the computation failed: no depth"
