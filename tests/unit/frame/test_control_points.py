"""Ground control points: their file, the fit with a deviation that covers the error, and wrong points."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.errors import InputError
from sfm_app.frame.control_points import (
    ControlFit,
    agreeing_points,
    find_mistake,
    fit_control_points,
    read_control_points,
)
from sfm_app.frame.coordinates import LocalFrame, MapFrame, read_system
from sfm_app.frame.known_lengths import is_normalized, marks_in_pixels
from sfm_app.frame.sighted_points import SightedPoint
from sfm_app.geometry.poses import Similarity
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.types import ControlPoint, ControlPoints, GpsPosition, Photo, PhotoSet

CRS = "EPSG:32632\n"


def read(tmp_path, text, files=()):
    path = tmp_path / "gcp_list.txt"
    path.write_text(text, encoding="utf-8")
    return read_control_points(path, files)


def test_marks_with_one_name_are_of_one_point(tmp_path):
    found = read(tmp_path, CRS + "1 2 3 100.5 200 a.jpg left\n1 2 3 110 210 b.jpg left\n4 5 6 1 2 a.jpg right\n")
    assert [point.name for point in found.points] == ["left", "right"]
    assert found.points[0].position == (1.0, 2.0, 3.0)
    assert found.points[0].marks == {"a.jpg": (100.5, 200.0), "b.jpg": (110.0, 210.0)}
    assert found.crs == "EPSG:32632"


FILES = ["in/My Photo 1.JPG", "IMG_7.jpg", "img_8.jpg", "img_8.xmp", "two/x.jpg", "three/x.jpg", "twin.jpg", "twin.png"]


@pytest.mark.parametrize(
    ("tail", "photo", "name"),
    [
        ("in/My Photo 1.JPG corner", "in/My Photo 1.JPG", "corner"),
        ("My Photo 1.JPG corner", "in/My Photo 1.JPG", "corner"),
        ("my photo 1.jpg  corner extra", "in/My Photo 1.JPG", "corner"),
        ("My Photo 1 corner", "in/My Photo 1.JPG", "corner"),
        ("my photo 1", "in/My Photo 1.JPG", "point 1"),
        ("img_7.JPG p", "IMG_7.jpg", "p"),
        ("IMG_8", "img_8.jpg", "point 1"),
        ("C:\\photos\\IMG_7.jpg p", "IMG_7.jpg", "p"),
        ("two/x.jpg p", "two/x.jpg", "p"),
        ("twin.png p", "twin.png", "p"),
    ],
)
def test_a_photo_is_found_by_what_people_write(tmp_path, tail, photo, name):
    (found,) = read(tmp_path, CRS + f"1 2 3 100 200 {tail}\n", FILES).points
    assert (list(found.marks), found.name) == ([photo], name)


@pytest.mark.parametrize("line", ["1,2,3,100,200,my photo 1.jpg,corner,x", "1; 2; 3; 100; 200; My Photo 1; corner"])
def test_other_dividers_are_read(tmp_path, line):
    (found,) = read(tmp_path, CRS + line, FILES).points
    assert (found.name, found.marks) == ("corner", {"in/My Photo 1.JPG": (100.0, 200.0)})


@pytest.mark.parametrize(
    ("tail", "says"),
    [("x.jpg p", "line 3 may mean three/x.jpg or two/x.jpg"), ("twin p", "line 3 may mean twin.jpg or twin.png")],
)
def test_a_photo_that_may_be_two_is_refused_with_its_line(tmp_path, tail, says):
    with pytest.raises(InputError, match=says):
        read(tmp_path, CRS + f"\n1 2 3 100 200 {tail}\n", FILES)


def test_marks_in_photos_of_another_folder_are_refused_and_some_are_not(tmp_path):
    other, own = "1 2 3 100 200 DSC 1.jpg p\n", "1 2 3 100 200 IMG_7.jpg p\n"
    with pytest.raises(InputError, match=r"line 2 names the photo 'DSC 1\.jpg', which the folder does not have"):
        read(tmp_path, CRS + other, FILES)
    assert set(read(tmp_path, CRS + other + own, FILES).points[0].marks) == {"DSC 1.jpg", "IMG_7.jpg"}


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_files_of_powershell_are_read(tmp_path, encoding):
    mark = {"utf-16-le": b"\xff\xfe", "utf-16-be": b"\xfe\xff"}.get(encoding, b"")
    path = tmp_path / "gcp_list.txt"
    path.write_bytes(mark + (CRS + "1 2 3 100 200 ä.jpg ö\r\n").encode(encoding))
    (found,) = read_control_points(path).points
    assert (found.name, list(found.marks)) == ("ö", ["ä.jpg"])


def test_marks_without_a_name_are_of_one_point_where_the_position_is(tmp_path):
    found = read(tmp_path, CRS + "1 2 3 100 200 a.jpg\n# a comment\n\n4 5 6 9 9 a.jpg\n1 2 3 110 210 b.jpg\n")
    assert [(point.name, len(point.marks)) for point in found.points] == [("point 1", 2), ("point 2", 1)]


def test_photo_names_may_have_spaces_where_tabs_divide(tmp_path):
    found = read(tmp_path, CRS + "1\t2\t3\t100\t200\tmy photo.jpg\tleft\n")
    assert set(found.points[0].marks) == {"my photo.jpg"}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no coordinate system"),
        ("# nothing\n", "no coordinate system"),
        (CRS, "no point"),
        (CRS + "1 2 3 4 5\n", "line 2 is malformed"),
        (CRS + "1 2 3 4 5 a.jpg\n1 2 x 4 5 b.jpg\n", "line 3 is malformed"),
        (CRS + "1 2 nan 4 5 a.jpg\n", "line 2 has a value out of range"),
        (CRS + "1 2 3 4 5 a.jpg\n7 8 9 1 2 a.jpg p p2\n1 2 3 4\n", "line 4 is malformed"),
        (CRS + "1 2 3 4 5 a.jpg p\n1 2 4 4 5 b.jpg p\n", "gives 'p' another position"),
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
    frame = LocalFrame(read_system("EPSG:32632"), UTM)
    enu = frame.positions(np.column_stack([targets[:, 0], -targets[:, 2], targets[:, 1]]))
    points = tuple(ControlPoint(f"p{k}", tuple(row), {}) for k, row in enumerate(enu.tolist()))
    located = {f"p{k}": SightedPoint(place, np.eye(3) * 1e-8, (), ()) for k, place in enumerate(places)}
    return ControlPoints(points, "EPSG:32632"), located, places


def test_five_points_give_the_place_and_the_size():
    given, located, places = survey(np.random.default_rng(0), 5, noise_m=0.0)
    found = fit_control_points(given, located)
    assert isinstance(found, ControlFit)
    assert found.from_model.scale == pytest.approx(TRUE.scale, rel=1e-9)
    mapped = MapFrame(found.place).positions(found.from_model(places))
    assert np.allclose(mapped, [point.position for point in given.points], atol=1e-4)
    assert found.place.origin == tuple(np.round(found.place.origin))  # whole meters
    assert found.place.system == "EPSG:32632"


@pytest.mark.parametrize("count", [4, 8])
def test_the_deviation_of_the_scale_covers_its_error(count):
    rng, normalized = np.random.default_rng(1), []
    for _ in range(60):
        given, located, _ = survey(rng, count)
        found = fit_control_points(given, located)
        normalized.append(np.log(found.from_model.scale / TRUE.scale) / found.deviation)
    assert 0.4 < np.std(normalized) < 1.3
    assert np.mean(np.abs(normalized) > 3) <= 0.02


def with_checks(given, first):
    """All points from the first one on as check points."""
    points = [replace(one, name=f"{'CHK-' if k >= first else ''}{one.name}") for k, one in enumerate(given.points)]
    return replace(given, points=tuple(points))


@pytest.mark.parametrize(("noise_m", "mark_m"), [(0.02, 0.001), (0.0, 0.03)])
@pytest.mark.parametrize("count", [4, 8])
def test_the_deviation_of_check_points_covers_their_error(count, noise_m, mark_m):
    rng, plan, height = np.random.default_rng(7), [], []
    for _ in range(80):
        given, located, places = survey(rng, count + 2, noise_m=noise_m)
        given = with_checks(given, count)
        spread = np.array([1.0, 3.0, 1.0]) * mark_m / TRUE.scale  # rays from above leave the height less sure
        turn = TRUE.R.T
        located = {
            point.name: SightedPoint(
                place + turn @ (spread * rng.normal(size=3)), turn @ np.diag(spread**2) @ turn.T, ("a", "b"), ()
            )
            for point, place in zip(given.points, places, strict=True)
        }
        for one in fit_control_points(given, located).surveyed[count:]:
            plan.append(one.plan_m / one.plan_deviation_m)
            height.append(one.height_m / one.height_deviation_m)
    for normalized in (plan, height):
        assert 0.4 < np.sqrt(np.mean(np.square(normalized))) < 1.2
        assert np.mean(np.abs(normalized) > 3) <= 0.02


def test_a_check_point_has_no_part_in_the_fit():
    given, located, places = survey(np.random.default_rng(8), 7)
    alone = fit_control_points(replace(given, points=given.points[:6]), located)
    moved = TRUE(places[6]) + np.array([0.3, -0.4, 0.0])
    (enu,) = LocalFrame(read_system("EPSG:32632"), UTM).positions(np.array([[moved[0], -moved[2], moved[1]]]))
    checked = replace(given.points[6], name="chk-far", position=tuple(enu.tolist()))
    found = fit_control_points(
        replace(given, points=(checked, *given.points[:6])), located | {"chk-far": located["p6"]}
    )
    assert (found.from_model.t == alone.from_model.t).all() and found.from_model.scale == alone.from_model.scale
    assert found.inliers == alone.inliers and not found.outliers and found.rms_m == alone.rms_m
    far = found.surveyed[0]
    assert (far.role, far.is_inside) == ("check", False)
    assert far.plan_m == pytest.approx(0.3, abs=0.03) and far.height_m == pytest.approx(0.4, abs=0.03)
    assert [(one.role, one.is_inside) for one in found.surveyed[1:]] == [("used", None)] * 6


def test_check_points_alone_give_no_place_and_an_unsure_camera_widens_their_deviation():
    given, located, _ = survey(np.random.default_rng(9), 6)
    given = with_checks(given, 4)
    located = {f"CHK-{name}" if name in ("p4", "p5") else name: sight for name, sight in located.items()}
    assert "2 of 2 ground control points" in fit_control_points(replace(given, points=(*given.points[:2],
                                                                given.points[4])), located)  # fmt: skip
    located = {name: replace(sight, covariance=np.eye(3) * 1e-4) for name, sight in located.items()}
    # two photos agree by chance: their marks are no better than those of the others
    sharp = located | {"CHK-p4": replace(located["CHK-p4"], covariance=np.eye(3) * 1e-6, sigma_px=0.1)}
    lucky, usual = (fit_control_points(given, places).surveyed[4] for places in (sharp, located))
    assert lucky.plan_deviation_m == pytest.approx(usual.plan_deviation_m, rel=1e-6)
    sure, unsure = (fit_control_points(given, located, shape).surveyed[4] for shape in (0.0, 0.05))
    assert unsure.plan_deviation_m > 1.5 * sure.plan_deviation_m


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


def surveyed(crs="EPSG:32632", place=(9.7, 48.1), count=8, noise_m=0.01, flat=False, seed=0):
    """Control points of a scene of 100 m in a system, and their places in an upright model."""
    rng = np.random.default_rng(seed)
    enu = rng.uniform(-1, 1, size=(count, 3)) * [50.0, 40.0, 0.0 if flat else 12.0]
    gps, system = read_system("EPSG:4979"), read_system(crs)
    measured = LocalFrame(gps, np.array([*place, 300.0])).positions(enu + noise_m * rng.normal(size=enu.shape))
    positions = system.positions(gps.geocentric_m(measured))
    places = np.column_stack([enu[:, 0], enu[:, 2], -enu[:, 1]]) @ axis_rotation(np.array([0.0, 1.0, 0.0]), 70.0) / 12.0
    located = {f"p{k}": SightedPoint(x, np.eye(3) * 1e-7, (), ()) for k, x in enumerate(places)}
    return positions, located


def points_at(positions, crs):
    points = (ControlPoint(f"p{k}", tuple(row), {}) for k, row in enumerate(np.asarray(positions).tolist()))
    return ControlPoints(tuple(points), crs)


HERE = [GpsPosition(48.1, 9.7, 310.0), GpsPosition(48.1001, 9.7, None)]
SWAPPED = [1, 0, 2]


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize(
    ("crs", "says"),
    [
        ("EPSG:4326", "latitude and longitude are swapped"),
        ("EPSG:4258", "latitude and longitude are swapped"),
        ("EPSG:32632", "x and y are swapped"),
        ("+proj=utm +zone=32 +datum=WGS84", "x and y are swapped"),
        ("EPSG:31467", "x and y are swapped"),
    ],
)
def test_swapped_coordinates_are_named_and_not_used(crs, says, flat):
    positions, located = surveyed(crs, flat=flat)
    text, unusable = find_mistake(points_at(positions[:, SWAPPED], crs), located, [])
    assert says in text and unusable
    assert "if so, they miss by" in text
    assert find_mistake(points_at(positions, crs), located, []) == ("", False)


def test_swapped_axes_of_ones_own_are_named():
    positions, located = surveyed("EPSG:32632")
    own = positions - positions.mean(axis=0)
    assert find_mistake(points_at(own, "local"), located, HERE) == ("", False)
    text, unusable = find_mistake(points_at(own[:, SWAPPED], "local"), located, HERE)
    assert "x and y are swapped" in text and unusable


@pytest.mark.parametrize(
    ("crs", "wrong", "zone"),
    [
        ("EPSG:32632", "EPSG:32633", 32),
        ("EPSG:25832", "EPSG:25831", 32),
        ("+proj=utm +zone=32 +datum=WGS84", "+proj=utm +zone=33 +datum=WGS84", 32),
        ("WGS84 UTM 32N", "WGS84 UTM 33N", 32),
    ],
)
def test_a_wrong_zone_is_named_by_the_gps_of_the_photos(crs, wrong, zone):
    positions, located = surveyed(crs)
    text, unusable = find_mistake(points_at(positions, wrong), located, HERE)
    assert f"the zone is {zone}" in text and "from the GPS positions of the photos" in text
    assert not unusable, "the size is right"
    assert find_mistake(points_at(positions, crs), located, HERE) == ("", False)


def test_heights_in_meters_beside_feet_are_named():
    positions, located = surveyed("EPSG:2263", (-73.9, 40.7))
    assert find_mistake(points_at(positions, "EPSG:2263"), located, []) == ("", False)
    text, unusable = find_mistake(points_at(positions * [1.0, 1.0, 0.3048], "EPSG:2263"), located, [])
    assert "heights are in meters" in text and unusable


def test_points_that_fit_badly_without_a_known_mistake_are_named():
    positions, located = surveyed(noise_m=5.0)
    text, unusable = find_mistake(points_at(positions, "EPSG:32632"), located, HERE)
    assert "miss their places by" in text and "check the coordinate system" in text and not unusable
    text, _ = find_mistake(points_at(surveyed(noise_m=0.01)[0], "EPSG:2154"), located, [])
    assert "degrees outside of the area of EPSG:2154" in text


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32632", "local"])
def test_sound_points_with_a_wrong_one_raise_no_alarm(crs):
    for seed in range(30):
        positions, located = surveyed("EPSG:32632" if crs == "local" else crs, count=6 + seed % 4, seed=seed)
        if crs != "EPSG:4326" and seed % 2:
            positions[2] += [3.0, -2.0, 4.0]
        assert find_mistake(points_at(positions, crs), located, HERE) == ("", False)


def test_marks_as_shares_become_pixels(tmp_path):
    photos = (Photo("a.jpg", 400, 300, "g"), Photo("b.jpg", 400, 300, "g", turn_deg=90))
    marks = {"a.jpg": (0.25, 0.5), "b.jpg": (0.25, 0.5)}
    given = ControlPoints((ControlPoint("p", (0.0, 0.0, 0.0), marks),), "local")
    assert is_normalized(given)
    scaled = marks_in_pixels(PhotoSet(tmp_path, photos), given)
    assert scaled.points[0].marks == {"a.jpg": (100.0, 150.0), "b.jpg": (75.0, 200.0)}
    assert not is_normalized(scaled)
