"""Corners by all edges of a pattern: exact, and as exact as they say, through blur and the tone curve of a camera."""

import cv2
import numpy as np
import pytest

from sfm_app.frame.markers import draw_pattern, edge_sides, find_markers, fit_pattern, side_px

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


@pytest.mark.parametrize(("side", "limit"), [(45, 0.0012), (90, 0.0003)])
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


def test_the_outline_alone_is_half_a_pixel_too_small():
    """Why all edges are used: what OpenCV finds by itself, in the same photos."""
    rng, ratios = np.random.default_rng(5), []
    options = cv2.aruco.DetectorParameters()
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
