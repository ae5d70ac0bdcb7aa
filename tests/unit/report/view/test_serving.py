"""The server of a page: whom it answers, what, and how it ends."""

import http.client
import os
import signal
import sys
from threading import Thread
from types import SimpleNamespace

import pytest

from sfm_app.errors import ConfigError
from sfm_app.progress import SilentProgress
from sfm_app.report import server as serving
from sfm_app.report.server import LOOPBACK, open_server, serve_run


@pytest.fixture
def server(resources):
    """A server that runs until the test ends."""
    with open_server(resources) as found:
        thread = Thread(target=found.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield found
        found.shutdown()
        thread.join()


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


@pytest.mark.parametrize(
    "address", ["/../secret.txt", "/photos/../../secret.txt", "/..%2fsecret.txt", "/manifest.json"]
)
def test_files_that_the_page_does_not_load_are_not_there(server, address):
    answer, body = ask(server, address)

    assert answer.status == 404 and b"secret" not in body


def test_nothing_can_be_sent_to_it(server):
    assert ask(server, "/", "POST")[0].status == 501


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
            SimpleNamespace(progress=SilentProgress()), 0, lambda address: Thread(target=browse, args=[address]).start()
        )
    finally:
        signal.signal(signal.SIGINT, before)

    assert answers == [200]
