from types import SimpleNamespace

import pytest

from sfm_app.mapping.split_and_merge import OPTIONS, weakly_joined_parts

pytestmark = pytest.mark.slow


def model(*tracks):
    """A model of photos 1 to 6, or those that its points are seen by: (photos, how many such points)."""

    def point(photos):
        return SimpleNamespace(track=SimpleNamespace(elements=[SimpleNamespace(image_id=photo) for photo in photos]))

    points = [point(photos) for photos, count in tracks for _ in range(count)]
    placed = {photo for photos, _ in tracks for photo in photos}
    images = {
        photo: SimpleNamespace(image_id=photo, name=f"{photo}.jpg", has_pose=photo in placed) for photo in range(1, 8)
    }
    return SimpleNamespace(images=images, points3D=dict(enumerate(points)))


def test_photos_that_see_what_two_others_see_are_well_joined():
    assert weakly_joined_parts(model(((1, 2, 3), 40), ((2, 3, 4), 40), ((3, 4, 5), OPTIONS.min_common_points))) == []


def test_parts_that_share_hardly_a_point_of_three_photos_are_named():
    tracks = ((1, 2, 3), 40), ((3, 4), 200), ((2, 3, 4), OPTIONS.min_common_points - 1), ((4, 5, 6), 30)
    # 4 hangs on four points, and 5 and 6 on photo 4 alone
    assert weakly_joined_parts(model(*tracks)) == [["1.jpg", "2.jpg"], ["5.jpg", "6.jpg"]]


def test_a_chain_of_pairs_has_no_scale_at_all():
    assert weakly_joined_parts(model(((1, 2), 50), ((2, 3), 40), ((3, 4), 30))) == [["3.jpg"], ["4.jpg"]]


def test_two_photos_and_none_have_nothing_to_be_joined_to():
    assert weakly_joined_parts(model(((1, 2), 50))) == [] and weakly_joined_parts(model()) == []
