import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.synthetic.shapes import PATTERNS, Material, bricks, cells, lattice, mixture, octaves, value_noise

POINTS = np.random.default_rng(0).uniform(-3, 3, (400, 3))
UP = (0.0, 1.0, 0.0)
PLACES = st.floats(-100, 100)


def test_lattice_values_are_uniform_and_unrelated():
    values = np.array([lattice(i, j, -i, 5) for i in range(-40, 40) for j in range(50)])
    neighbors = np.array([lattice(i + 1, j, -i - 1, 5) for i in range(-40, 40) for j in range(50)])

    assert values.min() >= 0 and values.max() < 1
    assert np.allclose(np.quantile(values, [0.25, 0.5, 0.75]), [0.25, 0.5, 0.75], atol=0.03)
    assert abs(np.corrcoef(values, neighbors)[0, 1]) < 0.05


@given(x=PLACES, y=PLACES, z=PLACES)
@settings(deadline=None)  # the first call compiles
def test_noise_is_bounded_and_continuous(x, y, z):
    here, near = value_noise(x, y, z, 3), value_noise(x + 1e-6, y - 1e-6, z + 1e-6, 3)
    assert -1 <= here < 1
    assert abs(here - near) < 1e-4


def test_noise_takes_the_lattice_values():
    assert value_noise(4.0, -2.0, 7.0, 9) == pytest.approx(2 * lattice(4, -2, 7, 9) - 1)


def test_detail_below_a_pixel_is_left_out():
    coarse = np.array([octaves(tuple(p), 1.0, 0.7, 2.0, 1) for p in POINTS])
    medium = np.array([octaves(tuple(p), 1.0, 0.7, 0.2, 1) for p in POINTS])
    fine = np.array([octaves(tuple(p), 1.0, 0.7, 0.002, 1) for p in POINTS])

    assert not coarse.any()
    assert 0.1 < medium.std() < fine.std() < 1.0


def test_octaves_fade_out_without_a_jump():
    p = (0.3, 1.7, -0.4)
    sizes = np.linspace(0.01, 1.1, 4000)
    values = np.array([octaves(p, 1.0, 0.7, footprint, 1) for footprint in sizes])
    assert np.abs(np.diff(values)).max() < 0.05


def test_bricks_are_laid_in_running_bond():
    center, name = bricks(1.0, 0.5, 0)
    assert center == pytest.approx(0.5) and bricks(1.9, 0.9, 0)[1] == name
    assert bricks(0.0, 0.5, 0)[0] == pytest.approx(0.0), "a joint between two bricks of row 0"
    assert bricks(0.0, 1.5, 0)[0] == pytest.approx(0.5), "the middle of a brick of row 1"
    assert bricks(2.5, 0.5, 0)[1] != name


def test_cells_have_borders_and_names():
    found = np.array([cells(x, y, 2) for x in np.linspace(0, 8, 80) for y in np.linspace(0, 8, 80)])
    assert found[:, 0].min() >= 0 and found[:, 0].min() < 0.02 and 0.2 < found[:, 0].max() < 1.0
    assert 40 < len(np.unique(found[:, 1])) < 130, "about one name per unit square"


@pytest.mark.parametrize("pattern", PATTERNS)
def test_patterns_mix_within_range_and_vary(pattern):
    row = Material(pattern=pattern, base=(200, 10, 10), second=(10, 200, 10)).row(seed=100)
    other = Material(pattern=pattern, base=(200, 10, 10), second=(10, 200, 10)).row(seed=200)
    mixed = np.array([mixture(row, tuple(p), UP, 0.005) for p in POINTS])
    again = np.array([mixture(row, tuple(p), UP, 0.005) for p in POINTS])
    elsewhere = np.array([mixture(other, tuple(p), UP, 0.005) for p in POINTS])

    assert mixed[:, :2].min() >= 0 and mixed[:, :2].max() <= 1
    assert mixed[:, 2].min() > 0 and 0.7 < mixed[:, 2].mean() < 1.3
    assert mixed[:, 0].std() > 0.05 and mixed[:, 2].std() > 0.05
    assert np.array_equal(mixed, again)
    assert not np.allclose(mixed[:, 2], elsewhere[:, 2]), "two bodies of one material differ"


def test_material_colors_are_linear():
    row = Material(pattern="wood", base=(255, 0, 128), second=(0, 0, 0)).row(seed=7)
    assert row.shape == (13,)
    assert row[:4].tolist() == [PATTERNS.index("wood"), 0.3, 0.5, 7]
    assert row[4:7] == pytest.approx([1.0, 0.0, (128 / 255) ** 2.2])


def test_masonry_turns_with_its_body():
    """The normal is that in the scene, the position that on the body: a turned house keeps its bricks."""
    row = Material(pattern="masonry", base=(150, 76, 56), second=(188, 116, 84), scale=0.2).row(7)
    found = np.array([[mixture(row, tuple(p), n, 0.01) for p in POINTS] for n in ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))])
    assert np.array_equal(found[0], found[1])
    assert 0.02 < (found[0][:, 1] > 0.5).mean() < 0.5, "joints between bricks"
