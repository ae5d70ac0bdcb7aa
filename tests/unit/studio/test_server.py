"""The server of the studio: who may ask, what uploads may do, and that names are never paths."""

import http.client
import io
import json
import re
import socket
import threading
import time
from urllib.parse import quote

import numpy as np
import pytest
import uvicorn
from PIL import Image

from sfm_app.studio import server as studio_server
from sfm_app.studio.server import make_app

TOKEN = "a-token-of-this-test"  # noqa: S105


class Client:
    """Asks the studio as its page does, unless told otherwise."""

    def __init__(self, port, folder):
        self.port, self.folder = port, folder
        self.usual = {"Host": f"127.0.0.1:{port}", "Cookie": f"sfm-app-studio-{port}={TOKEN}"}

    def __call__(self, method, path, body=None, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        asked = {name: value for name, value in (self.usual | headers).items() if value is not None}
        data = json.dumps(body) if isinstance(body, dict) else body
        connection.request(method, path, data, asked)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer, content

    def json(self, *arguments):
        answer, content = self(*arguments)
        assert answer.status < 300, content
        return json.loads(content)


@pytest.fixture
def ask(tmp_path):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
        server = uvicorn.Server(uvicorn.Config(make_app(tmp_path / "models", TOKEN, port), log_level="error"))
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        while not server.started:
            time.sleep(0.01)
        yield Client(port, tmp_path / "models")
        server.should_exit = True
        thread.join()


@pytest.fixture
def photo(tmp_path):
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (90, 120, 3), np.uint8)).save(tmp_path / "photo.jpg")
    return (tmp_path / "photo.jpg").read_bytes()


@pytest.fixture
def jug(ask):
    assert ask.json("POST", "/api/projects", {"name": "jug"}) == {"name": "jug"}
    return "/api/projects/jug"


def test_the_token_of_the_address_becomes_a_cookie(ask):
    answer, _ = ask("GET", f"/?token={TOKEN}", Cookie=None)
    assert (answer.status, answer.getheader("Location")) == (303, "/")
    cookie = answer.getheader("Set-Cookie")
    assert "HttpOnly" in cookie and "SameSite=strict" in cookie
    answer, content = ask("GET", "/", Cookie=cookie.partition(";")[0])
    assert answer.status == 200 and b"studio.js" in content


@pytest.mark.parametrize(
    "headers",
    [
        {"Cookie": None},
        {"Cookie": "sfm-app-studio-1=" + TOKEN},
        {"Host": "evil.example"},
        {"Host": "evil.example:80"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
    ],
)
@pytest.mark.parametrize(("method", "path"), [("GET", "/"), ("GET", "/api/projects"), ("POST", "/api/projects")])
def test_strangers_are_refused(ask, method, path, headers):
    answer, content = ask(method, path, {"name": "x"} if method == "POST" else None, **headers)
    assert answer.status == 403 and TOKEN.encode() not in content
    assert "default-src 'none'" in answer.getheader("Content-Security-Policy")
    assert not list(ask.folder.iterdir())


def test_every_answer_forbids_scripts_and_frames_of_others(ask, jug):
    for path in ("/", "/assets/studio.js", jug, "/api/nothing"):
        answer, _ = ask("GET", path)
        policy = answer.getheader("Content-Security-Policy")
        assert "default-src 'none'" in policy and "script-src 'self';" in policy and "unsafe" not in policy
        assert answer.getheader("X-Content-Type-Options") == "nosniff"


@pytest.mark.parametrize(
    "name", ["../../outside.jpg", "..%2f..%2foutside.jpg", "<img src=x onerror=alert(1)>.jpg", "a\0b.jpg"]
)
def test_names_of_uploads_are_never_paths_nor_markup(ask, jug, photo, name):
    kept = ask.json("PUT", f"{jug}/files/{quote(name, safe='')}", photo)["name"]
    assert (ask.folder / "jug" / "photos" / kept).read_bytes() == photo
    assert not set(kept) & set("<>/\\\0")
    assert [path.name for path in ask.folder.parent.rglob("*.jpg")] in ([kept, "photo.jpg"], ["photo.jpg", kept])
    answer, content = ask("GET", f"{jug}/photos/{quote(kept)}")
    assert answer.getheader("Content-Type") == "image/jpeg" and content[:2] == b"\xff\xd8"


@pytest.mark.parametrize(
    "path",
    [
        "/api/projects/..", "/api/projects/%2e%2e%2fmodels", "/api/projects/jug/photos/..%2fproject.json",
        "/api/projects/jug/view/points/..%2fresult.json", "/api/projects/jug/view/pictures/99",
        "/api/projects/jug/exports/..%2fproject.json", "/assets/..%2fserver.py", "/shared/../server.py",
    ],
)  # fmt: skip
def test_nothing_outside_has_an_address(ask, jug, path):
    answer, _ = ask("GET", path)
    assert answer.status in (404, 405)


def test_a_photo_outside_of_the_project_is_not_shown(ask, jug, photo):
    ask.json("PUT", f"{jug}/files/a.jpg", photo)
    place = ask.folder / "jug" / "photos" / ".." / ".." / ".." / "photo.jpg"
    assert place.resolve().read_bytes() == photo
    answer, _ = ask("GET", f"{jug}/photos/..%2f..%2f..%2fphoto.jpg")
    assert answer.status == 404


def test_an_upload_that_does_not_fit_on_the_disk_is_refused(ask, jug, monkeypatch):
    monkeypatch.setattr(studio_server, "FREE_BYTES", 2**60)
    answer, content = ask("PUT", f"{jug}/files/a.jpg", b"a photo")
    assert answer.status == 507 and b"disk is full" in content
    assert not list(ask.folder.rglob("*.jpg")) and not list(ask.folder.rglob(".upload*"))


def test_an_upload_without_a_size_is_refused(ask, jug):
    answer, _ = ask("PUT", f"{jug}/files/a.jpg", iter([b"a", b"b"]))
    assert answer.status == 411 and not list(ask.folder.rglob("*.jpg"))


@pytest.mark.parametrize("body", [b"no JSON", b"[]", b"3"])
def test_a_request_that_is_no_object_is_an_error(ask, jug, body):
    answer, content = ask("PATCH", jug, body)
    assert answer.status == 400 and b"message" in content


def test_a_wrong_setting_is_an_error_that_says_so(ask, jug):
    answer, content = ask("PATCH", jug, {"quality": "best"})
    assert answer.status == 400 and "quality" in json.loads(content)["message"]
    assert ask.json("GET", jug)["quality"] == "normal"


def test_photos_are_listed_and_can_be_taken_out(ask, jug, photo):
    for name in ("a.jpg", "b.jpg"):
        ask.json("PUT", f"{jug}/files/{name}", photo + name.encode())
    ask.json("DELETE", f"{jug}/photos", {"names": ["a.jpg"]})
    assert [row["name"] for row in ask.json("GET", f"{jug}/photos")] == ["b.jpg"]
    assert ask.json("GET", jug)["photos"] == 1


def test_ten_thousand_files_are_listed(ask, jug):
    folder = ask.folder / "jug" / "photos"
    folder.mkdir()
    for number in range(10_000):
        (folder / f"{number}.jpg").touch()
    assert len(ask.json("GET", f"{jug}/photos")) == 10_000


def test_an_unknown_action_stops_nothing(ask, jug):
    project = ask.json("GET", jug)
    ask.json("POST", f"{jug}/pause")
    answer, _ = ask("POST", f"{jug}/explode")
    assert answer.status == 404 and ask.json("GET", jug)["state"] == "paused" != project["state"]


def test_a_project_is_deleted_with_its_files(ask, jug, photo):
    ask.json("PUT", f"{jug}/files/a.jpg", photo)
    ask.json("DELETE", jug)
    assert ask.json("GET", "/api/projects") == [] and not list(ask.folder.iterdir())


def masks_of(ask):
    return {
        path.relative_to(ask.folder / "jug" / "masks").as_posix() for path in (ask.folder / "jug").rglob("masks/*.png")
    }


def test_a_mask_belongs_to_a_photo_and_goes_with_it(ask, jug, photo):
    for name in ("a.jpg", "b.jpg"):
        ask.json("PUT", f"{jug}/files/{name}", photo + name.encode())
    ask.json("PUT", f"{jug}/masks/a.jpg", b"painted")
    ask.json("PUT", f"{jug}/masks/b_mask.png", b"dropped")  # a name as of a folder of masks
    assert masks_of(ask) == {"a.jpg.png", "b.jpg.png"}
    assert [row["masked"] for row in ask.json("GET", f"{jug}/photos")] == [True, True]
    assert ask("GET", f"{jug}/masks/b.jpg")[1] == b"dropped"
    place = str(ask.folder / "jug" / "masks")
    assert f"--config {ask.folder / 'jug' / 'settings.toml'}" in ask.json("GET", jug)["command"]
    assert place in (ask.folder / "jug" / "settings.toml").read_text()
    ask.json("DELETE", f"{jug}/masks/b.jpg")
    ask.json("DELETE", f"{jug}/photos", {"names": ["a.jpg"]})  # alone, its mask would be that of all photos
    assert masks_of(ask) == set() and place not in (ask.folder / "jug" / "settings.toml").read_text()


@pytest.mark.parametrize("name", ["c.png", "..%2f..%2foutside", "..%2fproject.json", "a.jpg%2f..%2f..%2fproject.json"])
def test_a_mask_of_no_photo_is_refused(ask, jug, photo, name):
    ask.json("PUT", f"{jug}/files/a.jpg", photo)
    before = sorted(ask.folder.rglob("*"))
    for method in ("GET", "PUT", "DELETE"):
        answer, content = ask(method, f"{jug}/masks/{name}", b"x" if method == "PUT" else None)
        assert answer.status == 400 and json.loads(content)["hint"]
    assert sorted(ask.folder.rglob("*")) == before


def test_only_whole_photos_can_have_a_mask_painted(ask, jug, photo):
    for name in ("a.jpg", "film.mp4", "pack.zip"):
        ask.json("PUT", f"{jug}/files/{name}", photo if name == "a.jpg" else b"other")
    assert {row["name"] for row in ask.json("GET", f"{jug}/photos") if row["can_mask"]} == {"a.jpg"}


def test_what_has_no_picture_has_an_empty_one(ask, jug, photo):
    for name, kind in (("a.jpg", "image/jpeg"), ("film.mp4", "image/svg+xml")):
        ask.json("PUT", f"{jug}/files/{name}", photo if name == "a.jpg" else b"no picture")
        answer, content = ask("GET", f"{jug}/photos/{name}")
        assert (answer.status, answer.getheader("Content-Type")) == (200, kind) and content
    _, large = ask("GET", f"{jug}/photos/a.jpg?large")
    assert Image.open(io.BytesIO(large)).size == (120, 90)


def test_a_model_is_turned_and_turned_back(ask, jug):
    level = ["0,0,0", "1,0,0", "0,0,-1"]
    ask.json("PATCH", jug, {"level": level})
    assert ask.json("GET", jug)["level"] == [level]
    ask.json("POST", f"{jug}/cancel")
    answer, content = ask("PATCH", jug, {"level": ["0,0,0", "1,0,0", "2,0,0"]})
    assert answer.status == 400 and "on a line" in json.loads(content)["message"]
    assert ask.json("GET", jug)["state"] == "idle"  # what is wrong starts nothing
    ask.json("PATCH", jug, {"level": None})
    assert ask.json("GET", jug)["level"] == []


def test_a_project_gets_another_title_and_keeps_its_address(ask, jug):
    ask.json("PATCH", jug, {"title": "Grandma's <b>jug</b>"})
    assert [(one["name"], one["title"]) for one in ask.json("GET", "/api/projects")] == [
        ("jug", "Grandma's <b>jug</b>")
    ]
    assert ask.json("GET", jug)["title"] == "Grandma's <b>jug</b>"


@pytest.mark.parametrize("box", [[[0, 0]], "x", [[0, 0, 0], ["a", 0, 0]]])
def test_a_box_that_is_none_is_an_error(ask, jug, box):
    answer, content = ask("POST", f"{jug}/exports", {"format": "obj", "box": box})
    assert answer.status == 400 and json.loads(content)["message"] == "a box is two corners of three numbers"


def test_the_3d_view_is_of_this_version_whatever_wrote_its_data(ask, jug):
    assert ask("GET", f"{jug}/view/")[0].status == 404
    (ask.folder / "jug" / "view").mkdir()
    (ask.folder / "jug" / "view" / "view.json").write_text('{"view": {"size": 2.5}, "photos": []}')
    answer, content = ask("GET", f"{jug}/view/")
    assert (
        answer.getheader("Content-Type").startswith("text/html") and b'{"view": {"size": 2.5}, "photos": []}' in content
    )
    for script in re.findall(rb'src="(/[^"]+)"', content):
        assert ask("GET", script.decode())[0].status == 200
