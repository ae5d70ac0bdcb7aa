"""Photos beside their depth maps."""

import base64
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from sfm_app.colmap.dense import DenseStore
from sfm_app.report.pictures import MOST_SHOWN, UNKNOWN, depth_colors, depth_pictures, spread_names
from sfm_app.stereo import DepthMap, View


@pytest.fixture
def dense(tmp_path):
    """A photo of one gray whose left half is near, with a column of no depth."""
    (tmp_path / "images").mkdir()
    photo = np.full((60, 1200, 3), 128, np.uint8)
    (tmp_path / "images" / "<b>.jpg").write_bytes(cv2.imencode(".jpg", photo)[1].tobytes())
    depth = np.full((60, 1200), 2.0, np.float32)
    depth[:, 600:], depth[:, 1000:] = 8.0, 0.0
    view = View("<b>.jpg", np.eye(3), np.eye(3, 4), 1200, 60)
    DenseStore(tmp_path).write_maps(view, DepthMap(depth, np.ones((60, 1200, 3), np.float32)))
    return tmp_path


def contents(dense, **coverage):
    workspace = SimpleNamespace(dense=dense)
    run = SimpleNamespace(workspace=workspace, map=lambda work, items, _: [work(item) for item in items])
    return SimpleNamespace(run=run, counts=lambda stage: {"coverage": coverage} if stage == "depth_maps" else {})


def test_a_photo_stands_beside_its_depths_and_small(dense):
    found = depth_pictures(contents(dense, **{"<b>.jpg": 0.833, "gone.jpg": 0.5}))

    [picture] = found
    assert picture.name == "<b>.jpg"
    assert picture.text == "83 % of it has a depth, from 2 (yellow) to 8 (violet)"
    data = np.frombuffer(base64.b64decode(picture.address.partition(",")[2]), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB).astype(int)
    assert image.shape == (24, 960, 3) and picture.size == (960, 24)
    assert np.abs(image[12, 200] - 128).max() < 6
    near, far, nothing = (image[12, 480 + x] for x in (100, 320, 460))
    assert near[0] > 200 and near[1] > 200 and near[2] < 90
    assert far[2] > far[1] and far[0] < 110
    assert np.abs(nothing - UNKNOWN).max() < 10


def test_nothing_is_shown_before_there_are_depth_maps(dense):
    assert depth_pictures(contents(dense)) == []
    assert depth_pictures(contents(dense, **{"../images/<b>.jpg": 0.5})) == []


def test_colors_are_even_in_disparity_and_single_wrong_depths_do_not_matter():
    depth = np.concatenate([np.linspace(1.0, 10.0, 2000), [1e9, np.nan, 0.0, -1.0]])[None]

    colors, (near, far) = depth_colors(depth)

    assert 1.0 < near < 1.3 and 9.7 < far < 10.1
    assert (colors[0, -3:] == UNKNOWN).all() and (colors[0, -4] == colors[0, 1999]).all()
    brightness = colors[0, :2000].astype(float).sum(axis=1)
    assert brightness[0] > brightness[400] > brightness[1999]
    with pytest.raises(ValueError, match="no pixel"):
        depth_colors(np.zeros((2, 2)))


@pytest.mark.parametrize("count", [0, 1, MOST_SHOWN, 1000])
def test_photos_are_spread_over_the_set(count):
    names = [f"{k:04}" for k in range(count)]
    found = spread_names(names, MOST_SHOWN)
    assert len(found) == len(set(found)) == min(count, MOST_SHOWN)
    assert not count or (found[0], found[-1]) == (names[0], names[-1])
