"""Files of ground control points, in the form of OpenDroneMap's gcp_list.txt."""

import pytest

from sfm_app.errors import InputError
from sfm_app.frame.control_points import read_control_points

UTM = "EPSG:32632\n"


def read(tmp_path, text):
    path = tmp_path / "gcp_list.txt"
    path.write_text(text, encoding="utf-8")
    return read_control_points(path)


def test_marks_with_one_name_are_of_one_point(tmp_path):
    found = read(tmp_path, UTM + "1 2 3 100.5 200 a.jpg left\n1 2 3 110 210 b.jpg left\n4 5 6 1 2 a.jpg right\n")

    assert [point.name for point in found.points] == ["left", "right"]
    assert found.points[0].position == (1.0, 2.0, 3.0)
    assert found.points[0].marks == {"a.jpg": (100.5, 200.0), "b.jpg": (110.0, 210.0)}
    assert not found.geographic


def test_marks_without_a_name_are_of_one_point_where_the_position_is(tmp_path):
    found = read(tmp_path, UTM + "1 2 3 100 200 a.jpg\n# a comment\n\n4 5 6 9 9 a.jpg\n1 2 3 110 210 b.jpg\n")
    assert [(point.name, len(point.marks)) for point in found.points] == [("point 1", 2), ("point 2", 1)]


def test_photo_names_may_have_spaces_where_tabs_divide(tmp_path):
    found = read(tmp_path, UTM + "1\t2\t3\t100\t200\tmy photo.jpg\tleft\n")
    assert set(found.points[0].marks) == {"my photo.jpg"}


@pytest.mark.parametrize("crs", ["EPSG:4326", "+proj=longlat +datum=WGS84", "WGS84"])
def test_longitude_and_latitude_are_known_as_such(tmp_path, crs):
    assert read(tmp_path, f"{crs}\n8.5 47.4 400 10 20 a.jpg\n").geographic


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no coordinate system"),
        ("# nothing\n", "no coordinate system"),
        (UTM, "no point"),
        (UTM + "1 2 3 4 5\n", "line 2 is malformed"),
        (UTM + "1 2 3 4 5 a.jpg\n1 2 x 4 5 b.jpg\n", "line 3 is malformed"),
        (UTM + "1 2 nan 4 5 a.jpg\n", "line 2 has a value out of range"),
        ("EPSG:4326\n8 97 0 4 5 a.jpg\n", "line 2 has a value out of range"),
        (UTM + "1 2 3 4 5 a.jpg p\n1 2 4 4 5 b.jpg p\n", "gives 'p' another position"),
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
    one, other = (read(tmp_path, UTM + f"1 2 3 {x} 200 a.jpg\n") for x in (100, 101))
    assert one.digest != other.digest
