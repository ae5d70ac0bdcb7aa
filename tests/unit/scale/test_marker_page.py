"""Pages of markers: they are found in the drawing, at their size."""

import re
from typing import get_args

import cv2
import numpy as np
import pytest

from sfm_app.errors import ConfigError, InputError
from sfm_app.frame.markers import (
    AUTO,
    FAMILIES,
    PAGES_MM,
    TRIED,
    draw_pattern,
    find_markers,
    marker_places,
    write_marker_page,
)
from sfm_app.settings import ScaleSettings

PX_PER_MM = 4.0


def drawn(path, paper="a4"):
    """The dark bars of an SVG page as an image of PX_PER_MM."""
    width, height = PAGES_MM[paper]
    image = np.full((round(height * PX_PER_MM), round(width * PX_PER_MM)), 255, np.uint8)
    points = PX_PER_MM * 25.4 / 72  # an SVG of matplotlib is in points
    drawn = re.findall(r'<path d="(M [^"]*z)\s*"([^>]*)>', path.read_text().replace("\n", " "))
    for outline in (bar for bar, style in drawn if "fill: #ffffff" not in style):
        corners = np.array(re.findall(r"-?[\d.]+", outline), float).reshape(-1, 2)
        # whole pixels: the edges of OpenCV's polygons belong to them
        low, high = np.round(corners.min(axis=0) * points), np.round(corners.max(axis=0) * points)
        image[int(low[1]) : int(high[1]), int(low[0]) : int(high[0])] = 0
    return image


@pytest.mark.parametrize("family", ["apriltag-36h11", "aruco-4x4"])
def test_all_markers_of_a_page_are_found_at_their_size(tmp_path, family):
    count = write_marker_page(tmp_path / "page.svg", 0.05, family, first=3)
    found = find_markers(drawn(tmp_path / "page.svg"), (family,))

    assert sorted(marker.number for marker in found) == list(range(3, 3 + count))
    for marker in found:
        sides = np.linalg.norm(marker.corners - np.roll(marker.corners, 1, axis=0), axis=1)
        assert np.allclose(sides, 50 * PX_PER_MM, atol=1.0)


@pytest.mark.parametrize(("kind", "begins"), [("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_a_page_is_the_same_each_time(tmp_path, kind, begins):
    for name in ("one", "other"):
        write_marker_page(tmp_path / f"{name}.{kind}", 0.08)
    data = (tmp_path / f"one.{kind}").read_bytes()
    assert data.startswith(begins)
    assert data == (tmp_path / f"other.{kind}").read_bytes()


@pytest.mark.parametrize("paper", PAGES_MM)
@pytest.mark.parametrize("side", [0.02, 0.05, 0.15])
def test_markers_do_not_touch_each_other_or_the_margin(paper, side):
    cells = len(draw_pattern("apriltag-36h11", 0))
    places, margin = marker_places(side, cells, paper), 1000 * side / cells
    assert places
    width, height = PAGES_MM[paper]
    for x, y in places:
        assert margin <= x <= width - margin - 1000 * side
        assert margin <= y <= height - margin - 1000 * side
    gaps = [max(abs(a[0] - b[0]), abs(a[1] - b[1])) for a in places for b in places if a != b]
    assert min(gaps, default=np.inf) >= 1000 * side + 2 * margin - 1e-9


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"side_m": 0.5}, "no marker of 50 cm fits"),
        ({"family": "qr"}, "no family of markers"),
        ({"paper": "b5"}, "no paper"),
        ({"first": 5000}, "or none has number 5000"),
    ],
)
def test_what_does_not_fit_is_said(tmp_path, change, says):
    with pytest.raises(ConfigError, match=says):
        write_marker_page(tmp_path / "page.pdf", **({"side_m": 0.05} | change))


def test_the_families_of_the_settings_are_those_that_are_known():
    assert set(get_args(ScaleSettings.model_fields["marker_family"].annotation)) == {AUTO, *FAMILIES}
    assert set(TRIED) < set(FAMILIES)


def test_other_files_and_folders_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="PDF or SVG"):
        write_marker_page(tmp_path / "page.png", 0.05)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write"):
        write_marker_page(tmp_path / "file" / "page.pdf", 0.05)


def test_ordinary_pictures_hold_no_markers():
    rng = np.random.default_rng(0)
    checks = np.kron(rng.integers(0, 2, (30, 40)), np.ones((16, 16))) * 200 + 20
    picture = cv2.GaussianBlur(checks.astype(np.uint8), (0, 0), 1.0)
    assert not find_markers(picture, ("apriltag-36h11",))
