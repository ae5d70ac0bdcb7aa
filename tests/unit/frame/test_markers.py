"""Corners by all edges of a pattern, through blur and tone curve; pages of markers, at their size."""

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
    edge_sides,
    find_markers,
    fit_pattern,
    marker_places,
    side_px,
    write_marker_page,
)
from sfm_app.settings import ScaleSettings

FAMILY, NUMBER = "apriltag-36h11", 7
SHARPNESS = 8
"""Rays per pixel in x and in y."""


def photograph(side, rng, blur_px=0.7, size=300):
    """A photo of a marker that is tilted by up to 55 degrees, and the corners that it has."""
    f, pattern = 1.5 * size, draw_pattern(FAMILY, NUMBER)
    tilt, turn, roll = np.radians(rng.uniform(0, 55)), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
    about = [(0, 0, roll), (tilt, 0, 0), (0, 0, turn)]
    R = np.linalg.multi_dot([cv2.Rodrigues(np.array(angles, np.float64))[0] for angles in about])
    K = np.array([[f, 0, size / 2], [0, f, size / 2], [0, 0, 1.0]])
    H = K @ np.column_stack([R[:, 0], R[:, 1], [*rng.uniform(-0.2, 0.2, 2), f / side]])
    cells, fine = len(pattern), 40
    board = np.pad(np.kron(pattern, np.ones((fine, fine))), 2 * fine, constant_values=255)
    step, start = 1 / (cells * fine), -0.5 - 2 / cells
    to_plane = np.array([[step, 0, start], [0, step, start], [0, 0, 1]])
    half, sharper = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), np.diag([SHARPNESS, SHARPNESS, 1.0])
    drawn = np.linalg.inv(half) @ sharper @ H @ to_plane @ half
    light = 0.05 + 0.8 * (board / 255.0) ** 2.2
    seen = cv2.warpPerspective(light, drawn, (SHARPNESS * size,) * 2, flags=cv2.INTER_LINEAR, borderValue=0.3)
    seen = cv2.GaussianBlur(cv2.resize(seen, (size, size), interpolation=cv2.INTER_AREA), (0, 0), blur_px)
    photo = 255 * seen ** (1 / 2.2) + rng.normal(0, 1.5, seen.shape)
    corners = np.array([[-0.5, -0.5, 1], [0.5, -0.5, 1], [0.5, 0.5, 1], [-0.5, 0.5, 1]]) @ H.T
    return np.clip(np.round(photo), 0, 255).astype(np.uint8), corners[:, :2] / corners[:, 2:]


@pytest.mark.parametrize(("side", "limit"), [pytest.param(45, 0.0012, marks=pytest.mark.slow), (90, 0.0003)])
def test_a_side_is_exact_through_blur_and_tone_curve(side, limit):
    rng, ratios, errors = np.random.default_rng(5), [], []
    for _ in range(8):
        photo, true = photograph(side, rng)
        (found,) = find_markers(photo, (FAMILY,))
        assert found.number == NUMBER
        ratios.append(side_px(found.corners) / side_px(true) - 1)
        errors.append(np.abs(found.corners - true).max())
    assert abs(np.mean(ratios)) < limit
    assert 1e-4 < np.max(errors) < 0.15


@pytest.mark.slow
def test_the_outline_alone_is_half_a_pixel_too_small():
    """Why all edges are used: what OpenCV finds by itself, in the same photos."""
    rng, ratios, options = np.random.default_rng(5), [], cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), options)
    for _ in range(8):
        photo, true = photograph(90, rng)
        corners, _, _ = detector.detectMarkers(photo)
        ratios.append(side_px(corners[0].reshape(4, 2).astype(np.float64)) / side_px(true) - 1)
    assert -0.015 < np.mean(ratios) < -0.003


def test_another_pattern_is_refused():
    photo, true = photograph(90, np.random.default_rng(1))
    assert fit_pattern(photo, draw_pattern(FAMILY, NUMBER), true) is not None
    others = [k for k in range(40) if k != NUMBER]
    assert [k for k in others if fit_pattern(photo, draw_pattern(FAMILY, k), true) is not None] == []


def test_edges_lie_between_a_light_and_a_dark_cell():
    pattern = np.array([[0, 0, 0], [0, 255, 0], [0, 0, 0]], np.uint8)
    light, dark = edge_sides(pattern)
    assert len(light) == len(dark) == 3 * (12 + 4)
    assert np.allclose(np.abs(dark - light).sum(axis=1), 1)
    inside = (np.floor(light) == 1).all(axis=1)
    assert inside.sum() == 3 * 4  # the light cell in the middle; all others lie around the marker


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
    ("change", "says"), [({"side_m": 0.5}, "no marker of 50 cm fits"), ({"first": 5000}, "or none has number 5000")]
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
