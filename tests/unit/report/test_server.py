"""`sfm-app view`: point levels, resources of the page, and the server."""

import http.client
import io
import logging
import os
import signal
import sys
from contextlib import contextmanager
from threading import Thread
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sfm_app.errors import ConfigError
from sfm_app.progress import Progress
from sfm_app.report import server as serving
from sfm_app.report.server import (
    BYTES,
    GLB,
    HTML,
    JPEG,
    LARGE_PX,
    LOOPBACK,
    POINT_BYTES,
    SMALL_PX,
    RunResources,
    asked_range,
    open_server,
    point_levels,
    serve_run,
)
from sfm_app.types import Model, Surface

PAGE = b"<!DOCTYPE html><title>a page</title>"
ALL = "0.0.0.0"  # noqa: S104 - behind a random token


@pytest.fixture
def resources(tmp_path):
    """A page, a model, 30 points and two photos, the second of which is gone."""
    root = tmp_path / "out"
    (root / "photos").mkdir(parents=True)
    (tmp_path / "secret.txt").write_text("secret", encoding="utf-8")
    (root / "model.glb").write_bytes(b"glTF" * 1000)
    Image.new("RGB", (3000, 1500), (200, 30, 30)).save(root / "photos" / "a b.jpg")
    points = Surface(np.zeros((30, 3)), np.zeros((0, 3), np.int64), np.zeros((30, 3), np.uint8))
    workspace = SimpleNamespace(root=root, photos=root / "photos")
    contents = SimpleNamespace(run=SimpleNamespace(workspace=workspace), stages={"files": {}}, counts=lambda _: {})
    made = RunResources(contents, ["a b.jpg", "gone.jpg"], Model(points))
    made.__dict__["page"] = PAGE
    return made


def surface(count):
    places = np.column_stack([np.arange(count), np.zeros(count), np.ones(count)]).astype(float)
    colors = np.column_stack([np.arange(count) % 251, np.zeros(count), np.full(count, 7)]).astype(np.uint8)
    return Surface(places, np.zeros((0, 3), np.int64), colors)


def unpack(data):
    count = len(data) // POINT_BYTES
    return np.frombuffer(data, "<f4", 3 * count).reshape(-1, 3), np.frombuffer(data, np.uint8, offset=12 * count)


def test_levels_have_every_point_once_with_its_color():
    found = point_levels(surface(150), first=20)

    assert [len(level) // POINT_BYTES for level in found] == [20, 40, 80, 10]
    parts = [unpack(level) for level in found]
    x = np.concatenate([places[:, 0] for places, _ in parts])
    colors = np.concatenate([colors.reshape(-1, 3) for _, colors in parts])
    np.testing.assert_array_equal(np.sort(x), np.arange(150))
    np.testing.assert_array_equal(colors[:, 0], x % 251)
    assert (colors[:, 2] == 7).all()


def test_the_first_level_is_spread_over_the_scene():
    found = point_levels(surface(100_000))
    x = unpack(found[0])[0][:, 0]
    assert abs(x.mean() / 100_000 - 0.5) < 0.02 and x.min() < 100 and x.max() > 99_900


def test_no_points_are_no_levels():
    assert point_levels(surface(0)) == []


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


@contextmanager
def running(resources, host=""):
    with open_server(resources, host=host) as found:
        thread = Thread(target=found.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield found
        found.shutdown()
        thread.join()


@pytest.fixture
def server(resources):
    """A server that runs until the test ends."""
    with running(resources) as found:
        yield found


@pytest.fixture
def public(resources):
    """A server that listens at all addresses, until the test ends."""
    with running(resources, ALL) as found:
        yield found


def ask(server, address="/", method="GET", **headers):
    """Send one request, with its path as it is, and return the answer and its body."""
    connection = http.client.HTTPConnection(LOOPBACK, server.port, timeout=20)
    connection.putrequest(method, address, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def test_a_browser_of_this_machine_gets_the_page(server, resources):
    assert server.address == f"http://127.0.0.1:{server.port}/" and server.server_address[0] == LOOPBACK
    for host in (f"127.0.0.1:{server.port}", f"localhost:{server.port}"):
        answer, body = ask(server, Host=host)
        assert (answer.status, body) == (200, resources.page)
        assert answer.headers["Content-Type"] == "text/html; charset=utf-8"
        assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"


def test_files_are_sent_whole_and_heads_without_a_body(server, resources):
    answer, body = ask(server, "/model.glb")
    assert (answer.status, body) == (200, b"glTF" * 1000)
    answer, body = ask(server, "/model.glb", "HEAD")
    assert (answer.headers["Content-Length"], body) == ("4000", b"")


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1:1", "127.0.0.1", "[::1]:{port}", ""]
)
def test_other_hosts_are_refused(server, host):
    answer, body = ask(server, Host=host.format(port=server.port))
    assert answer.status == 403 and b"only for the machine" in body


def test_two_hosts_in_one_request_are_refused(server):
    connection = http.client.HTTPConnection(LOOPBACK, server.port, timeout=20)
    connection.putrequest("GET", "/")  # with its own host
    connection.putheader("Host", "evil.example")
    connection.endheaders()
    assert connection.getresponse().status == 403
    connection.close()


def test_nothing_can_be_sent_to_it(server):
    assert ask(server, "/", "POST")[0].status == 501


def test_the_address_of_a_public_server_opens_the_page_and_sets_a_cookie_that_opens_the_rest(public, resources):
    assert public.server_address[0] == ALL and len(public.token) >= 40
    assert public.address == f"http://127.0.0.1:{public.port}/?token={public.token}"
    answer, body = ask(public, f"/?token={public.token}", Host="a-machine.example")
    assert (answer.status, body) == (200, resources.page)
    cookie, *limits = answer.headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict"} < set(limits)
    assert ask(public, "/model.glb", Cookie=f"other=1; {cookie}", Host="a-machine.example")[1] == b"glTF" * 1000


@pytest.mark.parametrize(
    ("query", "cookie"),
    [
        ("", ""), ("?token=", ""), ("?token=wrong", ""), ("?token={token}x", ""), ("?x={token}", ""),
        ("?token=%C3%A9é", ""), ("", "{name}="), ("", "{name}=wrong"), ("", "other={token}"), ("", "é"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("path", ["/", "/model.glb", "/nothing"])
def test_without_its_token_a_public_server_refuses(public, path, query, cookie):
    values = {"token": public.token, "name": f"sfm-app-{public.port}"}
    connection = http.client.HTTPConnection(LOOPBACK, public.port, timeout=20)
    request = (
        f"GET {path}{query.format(**values)} HTTP/1.1\r\nHost: localhost\r\nCookie: {cookie.format(**values)}\r\n\r\n"
    )
    connection.connect()
    connection.sock.sendall(request.encode("latin-1"))
    with connection.sock.makefile("rb") as file:
        answer = file.read()
    connection.close()
    assert answer.startswith(b"HTTP/1.1 403 ") and b"Set-Cookie" not in answer and b"token" in answer
    assert public.token.encode() not in answer


def test_each_public_server_has_its_own_token_and_the_log_has_none(public, resources, caplog):
    with open_server(resources, host=LOOPBACK) as other:
        assert other.token and other.token != public.token
    with caplog.at_level(logging.DEBUG, "sfm_app"):
        ask(public, f"/?token={public.token}")
    assert "GET /" in caplog.text and public.token not in caplog.text


def test_an_address_of_another_machine_is_an_error_that_says_so(resources):
    with pytest.raises(ConfigError, match=r"cannot listen at 192\.0\.2\.1: ") as caught:
        open_server(resources, host="192.0.2.1")
    assert ALL in caught.value.hint
    with pytest.raises(ConfigError, match=r"cannot listen at a\.\.b: "):
        open_server(resources, host="a..b")


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("bytes=0-0", range(1)), ("bytes=4-", range(4, 10)), ("bytes=4-99", range(4, 10)), ("bytes=-3", range(7, 10)),
        ("bytes=-99", range(10)), ("BYTES=2-3", range(2, 4)),
        ("bytes=10-", range(0)), ("bytes=10-12", range(0)), ("bytes=-0", range(0)),
        ("", None), ("bytes=-", None), ("bytes=5-4", None), ("bytes=0-1,3-4", None), ("bytes=a-b", None),
        ("lines=0-1", None), ("bytes=+1-2", None), ("bytes=١-2", None), ("bytes=" + "9" * 5000 + "-", None),
    ],
)  # fmt: skip
def test_a_range_is_clipped_to_ten_bytes_and_none_if_malformed(header, expected):
    assert asked_range(header, 10) == expected


@pytest.mark.parametrize("address", ["/model.glb", "/"])
def test_a_part_of_a_resource_says_which_it_is(server, resources, address):
    whole = ask(server, address)[1]
    answer, body = ask(server, address, Range="bytes=5-8")
    assert (answer.status, body, answer.headers["Content-Length"]) == (206, whole[5:9], "4")
    assert answer.headers["Content-Range"] == f"bytes 5-8/{len(whole)}"
    answer, body = ask(server, address, Range="bytes=-7")
    assert (answer.status, body) == (206, whole[-7:])
    answer, body = ask(server, address, Range=f"bytes={len(whole)}-")
    assert (answer.status, body, answer.headers["Content-Range"]) == (416, b"", f"bytes */{len(whole)}")
    for headers in ({}, {"Range": "bytes=8-5"}):
        answer, body = ask(server, address, **headers)
        assert (answer.status, body, answer.headers["Accept-Ranges"]) == (200, whole, "bytes")
    assert ask(server, address, "HEAD", Range="bytes=5-8")[0].status == 200


@pytest.mark.parametrize("name", ["ETag", "Last-Modified"])
def test_a_part_of_a_file_that_has_changed_is_the_whole_new_file(server, resources, name):
    known = ask(server, "/model.glb")[0].headers[name]
    headers = {"Range": "bytes=0-3", "If-Range": known}
    assert ask(server, "/model.glb", **headers)[0].status == 206
    path = resources.find("/model.glb").content
    path.write_bytes(b"new!" * 1000)
    os.utime(path, (1_000_000_000, 1_000_000_000))
    answer, body = ask(server, "/model.glb", **headers)
    assert (answer.status, body) == (200, b"new!" * 1000)


def test_an_empty_file_has_no_parts(server, resources):
    resources.find("/model.glb").content.write_bytes(b"")
    assert ask(server, "/model.glb")[0].status == 200
    assert ask(server, "/model.glb", Range="bytes=-1")[0].status == 416


def test_a_port_that_is_taken_is_an_error_that_says_so(server, resources):
    with pytest.raises(ConfigError, match=f"port {server.port} is taken") as caught:
        open_server(resources, server.port)
    assert "free one" in caught.value.hint
    with pytest.raises(ConfigError, match="port 70000 cannot be used"):
        open_server(resources, 70_000)


@pytest.mark.skipif(sys.platform == "win32", reason="signals are another thing there")
def test_ctrl_c_ends_it(resources, monkeypatch):
    monkeypatch.setattr(serving, "read_resources", lambda _: resources)
    answers = []

    def browse(address):
        port = int(address.rstrip("/").rpartition(":")[2])
        answers.append(ask(SimpleNamespace(port=port))[0].status)
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        serve_run(
            SimpleNamespace(progress=Progress()), 0, lambda address: Thread(target=browse, args=[address]).start()
        )
    finally:
        signal.signal(signal.SIGINT, before)

    assert answers == [200]
