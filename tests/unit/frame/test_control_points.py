"""Ground control points: their file, the fit with a deviation that covers the error, and wrong points."""

import numpy as np
import pytest

from sfm_app.errors import InputError
from sfm_app.frame.control_points import ControlFit, agreeing_points, fit_control_points, read_control_points
from sfm_app.frame.sighted_points import SightedPoint
from sfm_app.geometry.poses import Similarity
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.types import ControlPoint, ControlPoints

CRS = "EPSG:32632\n"


def read(tmp_path, text):
    path = tmp_path / "gcp_list.txt"
    path.write_text(text, encoding="utf-8")
    return read_control_points(path)


def test_marks_with_one_name_are_of_one_point(tmp_path):
    found = read(tmp_path, CRS + "1 2 3 100.5 200 a.jpg left\n1 2 3 110 210 b.jpg left\n4 5 6 1 2 a.jpg right\n")
    assert [point.name for point in found.points] == ["left", "right"]
    assert found.points[0].position == (1.0, 2.0, 3.0)
    assert found.points[0].marks == {"a.jpg": (100.5, 200.0), "b.jpg": (110.0, 210.0)}
    assert not found.geographic


def test_marks_without_a_name_are_of_one_point_where_the_position_is(tmp_path):
    found = read(tmp_path, CRS + "1 2 3 100 200 a.jpg\n# a comment\n\n4 5 6 9 9 a.jpg\n1 2 3 110 210 b.jpg\n")
    assert [(point.name, len(point.marks)) for point in found.points] == [("point 1", 2), ("point 2", 1)]


def test_photo_names_may_have_spaces_where_tabs_divide(tmp_path):
    found = read(tmp_path, CRS + "1\t2\t3\t100\t200\tmy photo.jpg\tleft\n")
    assert set(found.points[0].marks) == {"my photo.jpg"}


@pytest.mark.parametrize("crs", ["EPSG:4326", "+proj=longlat +datum=WGS84", "WGS84"])
def test_longitude_and_latitude_are_known_as_such(tmp_path, crs):
    assert read(tmp_path, f"{crs}\n8.5 47.4 400 10 20 a.jpg\n").geographic


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no coordinate system"),
        ("# nothing\n", "no coordinate system"),
        (CRS, "no point"),
        (CRS + "1 2 3 4 5\n", "line 2 is malformed"),
        (CRS + "1 2 3 4 5 a.jpg\n1 2 x 4 5 b.jpg\n", "line 3 is malformed"),
        (CRS + "1 2 nan 4 5 a.jpg\n", "line 2 has a value out of range"),
        ("EPSG:4326\n8 97 0 4 5 a.jpg\n", "line 2 has a value out of range"),
        (CRS + "1 2 3 4 5 a.jpg p\n1 2 4 4 5 b.jpg p\n", "gives 'p' another position"),
        ("+proj=lcc +units=us-ft\n1 2 3 4 5 a.jpg\n", "not in meters"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, text, says):
    with pytest.raises(InputError, match=says) as caught:
        read(tmp_path, text)
    assert "geo_x geo_y geo_z" in caught.value.hint


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="cannot read the ground control points"):
        read_control_points(tmp_path / "none.txt")


def test_the_digest_changes_with_a_mark(tmp_path):
    one, other = (read(tmp_path, CRS + f"1 2 3 {x} 200 a.jpg\n") for x in (100, 101))
    assert one.digest != other.digest


TRUE = Similarity(12.0, axis_rotation(np.array([2.0, 6.0, 3.0]) / 7.0, 70.0), np.array([3.0, -1.0, 8.0]))
"""From the model to x east, y up, z south, less the offset."""
UTM = np.array([500_000.0, 4_649_000.0, 320.0])


def survey(rng, count, noise_m=0.01, wrong=(), miss_m=1.0):
    """Control points in UTM coordinates, and their places in the model."""
    places = rng.uniform(-1, 1, size=(count, 3)) * [1.0, 0.3, 1.0]
    targets = TRUE(places) + noise_m * rng.normal(size=(count, 3))
    for k in wrong:
        step = rng.normal(size=3)
        targets[k] += miss_m * step / np.linalg.norm(step)
    enu = np.column_stack([targets[:, 0], -targets[:, 2], targets[:, 1]]) + UTM
    points = tuple(ControlPoint(f"p{k}", tuple(row), {}) for k, row in enumerate(enu.tolist()))
    located = {f"p{k}": SightedPoint(place, np.eye(3) * 1e-8, (), ()) for k, place in enumerate(places)}
    return ControlPoints(points, "EPSG:32632"), located, places


def test_five_points_give_the_place_and_the_size():
    given, located, places = survey(np.random.default_rng(0), 5, noise_m=0.0)
    found = fit_control_points(given, located)
    assert isinstance(found, ControlFit)
    assert found.from_model.scale == pytest.approx(TRUE.scale, rel=1e-9)
    moved = found.from_model(places)
    east_north_up = np.column_stack([moved[:, 0], -moved[:, 2], moved[:, 1]]) + found.offset
    assert np.allclose(east_north_up, [point.position for point in given.points], atol=1e-6)
    assert found.offset == tuple(np.round(found.offset))  # whole meters
    assert found.crs == "EPSG:32632"


@pytest.mark.parametrize("count", [4, 8])
def test_the_deviation_of_the_scale_covers_its_error(count):
    rng, normalized = np.random.default_rng(1), []
    for _ in range(60):
        given, located, _ = survey(rng, count)
        found = fit_control_points(given, located)
        normalized.append(np.log(found.from_model.scale / TRUE.scale) / found.deviation)
    assert 0.4 < np.std(normalized) < 1.3
    assert np.mean(np.abs(normalized) > 3) <= 0.02


@pytest.mark.parametrize(
    ("count", "wrong"), [(5, (2,)), (8, (1, 5)), pytest.param(11, (0, 3, 7), marks=pytest.mark.slow)]
)
def test_wrong_points_are_named(count, wrong):
    rng, named, falsely = np.random.default_rng(2), 0, 0
    for _ in range(40):
        found = fit_control_points(*survey(rng, count, wrong=wrong, miss_m=0.5)[:2])
        named += set(found.outliers) >= {f"p{k}" for k in wrong}
        falsely += not set(found.outliers) <= {f"p{k}" for k in wrong}
    assert named >= 38
    assert falsely <= 1


@pytest.mark.parametrize("count", [5, 8, pytest.param(12, marks=pytest.mark.slow)])
def test_good_points_are_kept(count):
    rng = np.random.default_rng(3)
    kept = [agreeing_points(places, TRUE(places) + 0.01 * rng.normal(size=places.shape)).all()
            for places in (rng.uniform(-1, 1, size=(count, 3)) for _ in range(50))]  # fmt: skip
    assert np.mean(kept) >= 0.98


def test_too_few_points_and_points_on_a_line_give_a_reason():
    rng = np.random.default_rng(4)
    given, located, _ = survey(rng, 5)
    assert "3 are needed" in fit_control_points(given, dict(list(located.items())[:2]))
    on_line = {name: SightedPoint(k * np.ones(3), np.eye(3) * 1e-8, (), ()) for k, name in enumerate(located)}
    assert "on a line" in fit_control_points(given, on_line)


def test_longitude_and_latitude_become_meters():
    positions = {"a": (8.0, 47.0, 400.0), "b": (8.001, 47.0, 400.0), "c": (8.0, 47.001, 400.0)}
    points = tuple(ControlPoint(name, position, {}) for name, position in positions.items())
    given = ControlPoints(points, "EPSG:4326", geographic=True)
    places = {"a": (0, 0, 0), "b": (0.76057, 0, 0), "c": (0, 0, -1.11177)}
    located = {name: SightedPoint(np.array(at, float), np.eye(3) * 1e-9, (), ()) for name, at in places.items()}
    found = fit_control_points(given, located)
    assert found.from_model.scale == pytest.approx(100.0, rel=2e-3)
    assert np.allclose(found.from_model.R, np.eye(3), atol=2e-3)
    assert "47.0" in found.crs
