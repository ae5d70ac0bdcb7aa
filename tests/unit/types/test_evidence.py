"""A view graph survives its file."""

import io

import numpy as np

from sfm_app.types import Calibration, EpipolarFit, RayFit, Rejected, ViewGraph


def fit(n, degeneracy="", kind=EpipolarFit):
    rng = np.random.default_rng(n)
    return kind(rng.normal(size=(3, 3)), rng.random(n) < 0.5, rng.random(n), n, 0.5, degeneracy)


def through_file(graph):
    file = io.BytesIO()
    np.savez_compressed(file, **graph.to_arrays())
    file.seek(0)
    with np.load(file, allow_pickle=False) as arrays:
        return ViewGraph.from_arrays(dict(arrays)), file.getvalue()


def test_a_view_graph_survives_its_file():
    graph = ViewGraph({(1, 2): fit(5), (1, 7): fit(9, "planar")}, {(2, 7): Rejected("too few inliers")})

    back, data = through_file(graph)

    assert list(back.fits) == [(1, 2), (1, 7)]
    assert back.rejected == graph.rejected
    for pair, one in graph.fits.items():
        other = back.fits[pair]
        assert np.array_equal(one.F, other.F) and np.array_equal(one.inliers, other.inliers)
        assert np.array_equal(one.priors, other.priors)
        assert (one.trials, one.rms_px, one.degeneracy) == (other.trials, other.rms_px, other.degeneracy)
    assert through_file(graph)[1] == data


def test_wide_lenses_survive_with_it():
    lens = Calibration(np.diag([300.0, 300.0, 1.0]), 800, 600, "lens", True, projection="fisheye", distortion=(0.1,))
    graph = ViewGraph({(1, 2): fit(5, kind=RayFit), (1, 3): fit(6)}, {}, {"800x600": lens})

    back, _ = through_file(graph)

    assert back.lenses["800x600"].to_dict() == lens.to_dict()
    assert np.array_equal(back.fits[1, 2].E, graph.fits[1, 2].E) and not hasattr(back.fits[1, 2], "F")
    assert np.array_equal(back.fits[1, 3].F, graph.fits[1, 3].F) and not hasattr(back.fits[1, 3], "E")


def test_an_empty_view_graph_survives_too():
    back, _ = through_file(ViewGraph({}, {(1, 2): Rejected("x"), (1, 3): Rejected("x"), (2, 3): Rejected("y")}))

    assert not back.fits
    assert back.reasons == {"x": 2, "y": 1}
