"""What the page of a run may load."""

import io

import pytest
from PIL import Image

from sfm_app.report.server import BYTES, GLB, HTML, JPEG, LARGE_PX, SMALL_PX


def test_the_page_its_model_and_its_points_have_addresses(resources):
    assert resources.find("/").kind == HTML and resources.find("/?x=1").content == resources.page
    assert (resources.find("/model.glb").kind, resources.find("/model.glb").content.name) == (GLB, "model.glb")
    assert resources.find("/points/0").kind == BYTES and len(resources.find("/points/0").content) == 30 * 15


@pytest.mark.parametrize(("kind", "side"), [("pictures", SMALL_PX), ("photos", LARGE_PX)])
def test_photos_have_a_small_and_a_large_picture(resources, kind, side):
    found = resources.find(f"/{kind}/0")

    assert found.kind == JPEG and Image.open(io.BytesIO(found.content)).size == (side, side // 2)
    assert resources.find(f"/{kind}/1") is None


@pytest.mark.parametrize(
    "address",
    [
        "", "/../secret.txt", "/photos/../../secret.txt", "/photos/a%20b.jpg", "/photos/a b.jpg", "/photos/2",
        "/photos/-1",
        "/photos/0/../0", "/points/1", "/points/9999999999", "/manifest.json", "/secret.txt", "//model.glb",
        "/%2e%2e/secret.txt", "http://127.0.0.1/", "/photos/\u0660",
    ],
)  # fmt: skip
def test_nothing_else_has_an_address(resources, address):
    assert resources.find(address) is None


def test_a_lighter_model_is_made_once_and_only_for_a_large_model(resources):
    made = []
    resources.make_light = lambda contents: made.append(contents) or b"light"

    assert resources.find("/light.glb") is None and made == []
    resources.most_bytes = 10
    assert [resources.find("/light.glb").content for _ in range(2)] == [b"light"] * 2 and len(made) == 1


def test_a_lighter_model_that_fails_has_no_address(resources):
    def fail(contents):
        raise ValueError("no texture")

    resources.most_bytes, resources.make_light = 10, fail

    assert resources.find("/light.glb") is None
