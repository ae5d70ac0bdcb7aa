"""A server for the browsers of this machine.

It listens on the loopback address only. A page on the internet can let its own name point there (DNS rebinding), and
its scripts would then read the answers: so requests are refused unless they name the loopback address as their host.
"""

import errno
import logging
import os
import shutil
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import ThreadingTCPServer
from typing import Any

from sfm_app.errors import ConfigError
from sfm_app.operating_system import Ability, lacks
from sfm_app.report.view.resources import Resource, RunResources, read_resources
from sfm_app.runtime.context import RunContext

logger = logging.getLogger("sfm_app")

LOOPBACK = "127.0.0.1"
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Sent with every answer: no other page may embed or read it, and the next run on this port shows its own."""
TAKEN = (errno.EADDRINUSE, errno.EACCES)


class ViewServer(ThreadingTCPServer):
    """Serves the page of one run. It is no HTTPServer, which asks the network for the name of this machine."""

    daemon_threads = True
    allow_reuse_address = not lacks(Ability.REUSED_PORTS)

    def __init__(self, resources: RunResources, port: int) -> None:
        self.resources = resources
        super().__init__((LOOPBACK, port), ViewHandler)

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self.server_address[1])

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{LOOPBACK}:{self.port}/"

    @property
    def hosts(self) -> tuple[str, ...]:
        """What requests may call their host."""
        names = (LOOPBACK, "localhost")
        return (*(f"{name}:{self.port}" for name in names), *(names if self.port == 80 else ()))

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002 - the base class gives it
        """Note that a request was not answered to its end: mostly, the browser has left.

        Args:
            request, client_address: of the request.
        """
        logger.debug("a request of %s was not answered", client_address, exc_info=True)


class ViewHandler(BaseHTTPRequestHandler):
    """Answers one browser."""

    server: ViewServer
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "sfm-app", ""
    timeout = 60.0

    def do_GET(self) -> None:
        """Send what lies at the address."""
        self._answer()

    def do_HEAD(self) -> None:
        """Send the headers of what lies at the address."""
        self._answer()

    def log_message(self, format: str, *values: Any) -> None:  # noqa: A002 - the name that the base class gives it
        """Note a request in the log.

        Args:
            format, values: the message.
        """
        logger.debug(format, *values)

    def _answer(self) -> None:
        if self.headers.get_all("Host", []) not in [[host] for host in self.server.hosts]:
            self._refuse(HTTPStatus.FORBIDDEN, "This page is only for the machine that it is on.")
            return
        found = self.server.resources.find(self.path)
        if found is None:
            self._refuse(HTTPStatus.NOT_FOUND, "There is nothing at this address.")
        else:
            self._send(HTTPStatus.OK, found)

    def _refuse(self, status: HTTPStatus, text: str) -> None:
        self.close_connection = True
        self._send(status, Resource("text/plain; charset=utf-8", text.encode("utf-8")))

    def _send(self, status: HTTPStatus, found: Resource) -> None:
        if isinstance(found.content, Path):
            with found.content.open("rb") as file:
                self._send_headers(status, found.kind, os.fstat(file.fileno()).st_size)
                if self.command != "HEAD":
                    shutil.copyfileobj(file, self.wfile)
            return
        self._send_headers(status, found.kind, len(found.content))
        if self.command != "HEAD":
            self.wfile.write(found.content)

    def _send_headers(self, status: HTTPStatus, kind: str, length: int) -> None:
        self.send_response(status)
        for name, value in {**HEADERS, "Content-Type": kind, "Content-Length": str(length)}.items():
            self.send_header(name, value)
        self.end_headers()


def open_server(resources: RunResources, port: int = 0) -> ViewServer:
    """Start to listen, and return the server.

    Args:
        resources: of the run.
        port: 0 for any that is free.

    Raises:
        ConfigError: the port cannot be used.
    """
    try:
        return ViewServer(resources, port)
    except (OSError, OverflowError) as err:
        taken = isinstance(err, OSError) and err.errno in TAKEN
        why = f"is taken ({err.strerror})" if isinstance(err, OSError) and taken else f"cannot be used: {err}"
        raise ConfigError(f"port {port} {why}", hint="leave the port out for a free one") from err


def serve_run(run: RunContext, port: int, started: Callable[[str], None]) -> None:
    """Serve the page of a run until Ctrl-C.

    Args:
        run: with its output folder.
        port: 0 for any that is free.
        started: called with the address once the page can be opened.

    Raises:
        InputError: the folder holds no run.
        ConfigError: the port cannot be used.
    """
    run.progress.say("preparing the page")
    with open_server(read_resources(run), port) as server:
        try:
            started(server.address)
            server.serve_forever()
        except KeyboardInterrupt:
            logger.info("the view has ended")
