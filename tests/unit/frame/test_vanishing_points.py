"""Line segments in photos."""

import cv2
import numpy as np
import pytest

from sfm_app.frame.vanishing_points import line_segments, shrink


@pytest.mark.parametrize("size", [(600, 400), (3000, 2000)])
def test_edges_of_a_tilted_square(size):
    width, height = size
    corners = np.array([[0.3, 0.3], [0.7, 0.35], [0.65, 0.75], [0.25, 0.7]]) * [width, height]
    gray = np.full((height, width), 40, np.uint8)
    cv2.fillPoly(gray, [np.round(corners * 256).astype(np.int32)], 200, lineType=cv2.LINE_AA, shift=8)

    found = line_segments(gray)

    assert len(found) == 4
    for a, b in zip(corners + 0.5, np.roll(corners, -1, axis=0) + 0.5, strict=True):
        normal = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
        distances = np.abs((found.reshape(-1, 2, 2) - a) @ normal).max(axis=1)
        assert distances.min() < 0.003 * width


def test_no_edges_no_segments():
    assert line_segments(np.full((300, 400), 90, np.uint8)).shape == (0, 4)


@pytest.mark.parametrize(("size", "small"), [((1000, 1500), (171, 256)), ((40, 90), (40, 90))])
def test_a_photo_is_shrunk_in_its_shape(size, small):
    assert shrink(np.zeros(size, np.uint8), 256).shape == small
