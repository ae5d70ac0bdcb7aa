"""Charts, and their places on pages."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from painted_box import box, sightings

from sfm_app.texture.charts import MARGIN, Charts, absorb_small_charts, folds, pack
from sfm_app.texture.pages import owners
from sfm_app.texture.sightings import NONE, facets


def test_specks_go_over_to_their_neighbors():
    mesh = facets(box(6))
    chosen = np.zeros(len(mesh.faces), np.int32)
    chosen[100], chosen[200] = 1, 1
    usable = np.ones((2, len(chosen)), bool)
    usable[0, 200] = False
    found = absorb_small_charts(chosen, sightings(usable), mesh.neighbors)
    assert np.flatnonzero(found).tolist() == [200]


def test_a_fold_is_found_and_neighbors_are_not():
    corners = np.array([[[0, 0], [9, 0], [9, 9]], [[0, 0], [9, 9], [0, 9]], [[2, 1], [8, 1], [8, 7]]], float)
    assert folds(np.array([0, 0, 0], np.int32), 1, corners + 0.3).tolist() == [False, False, True]
    assert not folds(np.array([0, 0, 1], np.int32), 2, corners + 0.3).any()


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.sampled_from([256, 512]), st.integers(1, 3))
@settings(deadline=None, max_examples=25)
def test_packed_charts_keep_their_distance(seed, count, page_px, pages):
    rng = np.random.default_rng(seed)
    size = rng.uniform(1, 150, (count, 1, 1))
    corners = rng.uniform(0, 1, (count, 3, 2)) * size + rng.uniform(0, 900, (count, 1, 2))
    charts = Charts(np.arange(count, dtype=np.int32), np.zeros(count, np.int32), corners)
    blocks = np.array([[10, 6], [40, 2]], np.int32)
    layout, places = pack(charts, blocks, page_px, pages)
    assert all(max(width, height) <= page_px for width, height in layout.sizes)
    moved = corners * layout.scale + layout.shift[:, None, :]
    taken = [np.zeros((height, width), int) for width, height in layout.sizes]
    for chart in range(count):
        page = layout.page[chart]
        alone = owners(layout.sizes[page], np.array([chart]), moved) != NONE
        low, high = moved[chart].min(axis=0), moved[chart].max(axis=0)
        assert (low >= MARGIN - 1e-9).all()
        assert (high <= np.array(layout.sizes[page]) - MARGIN + 1e-9).all()
        taken[page] += alone
    for (page, x, y), (width, height) in zip(places, blocks, strict=True):
        taken[page][y : y + height, x : x + width] += 1
    assert max(int(page.max()) for page in taken) == 1
