import re
from dataclasses import replace

import numpy as np
import pytest

from sfm_app.errors import ConfigError
from sfm_app.report.figures import (
    OPTIONS,
    Panel,
    calibration_text,
    center_plane,
    check_figure,
    draw_calibration,
    focal_plane,
    vote_shares,
)
from sfm_app.selfcal.pairs import prepare
from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
from sfm_app.types import Calibration, CameraPairs

SPREAD = {"fx": 4.0, "fy": 3.0, "cx": 6.0, "cy": 5.0}


@pytest.fixture(scope="module")
def panel():
    """A camera that is known exactly, and exact fundamental matrices."""
    tracks = make_tracks(TrackOptions(cameras=5, sigma_px=0.0), seed=3)
    camera = Calibration(tracks.K[0], *tracks.size, "zero-curves", True, spread=SPREAD)
    return Panel("one", camera, CameraPairs.from_Fs(tracks.F, tracks.size))


def prepared(panel):
    width, height = panel.pairs.size
    return prepare(panel.pairs, unit_px=float(max(width, height)), origin_px=(width / 2, height / 2))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "start"), [("a.png", b"\x89PNG"), ("b.SVG", b"<?xml"), ("c.pdf", b"%PDF")])
def test_the_suffix_names_the_format_and_the_bytes_do_not_change(panel, tmp_path, name, start):
    places = [tmp_path / folder / name for folder in ("one", "two")]

    for place in places:
        draw_calibration(place, [panel])

    first, second = (place.read_bytes() for place in places)
    assert first.startswith(start)
    assert first == second


@pytest.mark.parametrize("name", ["figure.jpg", "figure", "png"])
def test_other_suffixes_are_refused_by_name(tmp_path, name):
    with pytest.raises(ConfigError, match=re.escape(f"figure {name}: cannot write")) as caught:
        check_figure(tmp_path / name)

    assert ".png" in caught.value.hint


@pytest.mark.parametrize("make", [focal_plane, center_plane])
def test_votes_are_unanimous_at_the_camera_and_nowhere_higher(panel, make):
    plane = make(panel.camera, prepared(panel))
    left, right, bottom, top = plane.extent

    shares = vote_shares(plane, panel.camera, prepared(panel))

    row, column = np.unravel_index(np.argmax(shares), shares.shape)
    cells = len(shares)
    peak = left + (right - left) * (column + 0.5) / cells, bottom + (top - bottom) * (row + 0.5) / cells
    assert abs(peak[0] - plane.estimate[0]) <= abs(right - left) / cells
    assert abs(peak[1] - plane.estimate[1]) <= abs(top - bottom) / cells
    assert 0.8 < shares.max() <= 1.0


@pytest.mark.parametrize("make", [focal_plane, center_plane])
def test_curves_pass_through_the_camera(panel, make):
    plane = make(panel.camera, prepared(panel))

    there = plane.curves(np.array([plane.estimate[0]]))[:, 0]

    # a pair may have a second real root there, and the curve may be the other one
    assert np.mean(np.abs(there - plane.estimate[1]) < 0.5) >= 0.7


def test_a_guess_is_drawn_without_pairs(panel, tmp_path):
    guess = replace(panel.camera, identifiable=False, method="guess", reason="no pairs", spread={})
    nothing = CameraPairs.from_Fs(np.zeros((0, 3, 3)), panel.pairs.size)

    draw_calibration(tmp_path / "guess.svg", [Panel("one", guess, nothing)])

    assert "no pair of photos is from this camera alone" in (tmp_path / "guess.svg").read_text()


@pytest.mark.slow
def test_of_many_cameras_the_first_are_drawn(panel, tmp_path):
    for count in (1, OPTIONS.most_cameras + 1):
        draw_calibration(tmp_path / f"{count}.svg", [panel._replace(name=f"camera-{k}") for k in range(count)])

    text = (tmp_path / f"{OPTIONS.most_cameras + 1}.svg").read_text()
    assert f"camera-{OPTIONS.most_cameras - 1}, one of {OPTIONS.most_cameras + 1}" in text
    assert f"camera-{OPTIONS.most_cameras}," not in text
    assert "camera-0" not in (tmp_path / "1.svg").read_text()


def test_the_words_leave_no_line_empty(panel):
    lines = calibration_text(panel.camera).splitlines()

    assert lines[0] == "Known: the photos agree on this camera."
    assert "± 4:" in lines[1]
    assert all(lines)
