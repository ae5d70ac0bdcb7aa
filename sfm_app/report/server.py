"""`sfm-app view`: a server for the browsers of this machine, or for all who have its token."""

import hmac
import io
import logging
import os
import re
import secrets
import shlex
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from email.utils import formatdate
from functools import cached_property
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import ThreadingTCPServer
from threading import Lock
from typing import Any
from urllib.parse import parse_qs

import numpy as np

from sfm_app.numerical import Json
from sfm_app.operating_system import Ability, lacks
from sfm_app.photos.decode import small_jpeg
from sfm_app.report.contents import UNREADABLE, RunContents
from sfm_app.report.findings import photo_names
from sfm_app.report.listening import HEADERS, LOOPBACK, explain_ports, page_address
from sfm_app.report.page import LargeParts, read_run, render_page
from sfm_app.report.scene_view import MOST_GLB_BYTES, light_model, model_file, view_frame, view_points
from sfm_app.runtime.context import RunContext
from sfm_app.types import Model, Surface

# Points in levels, from a coarse sample of the whole scene to all points.


POINT_BYTES = 15
"""Of a point in a level: x, y, z as little-endian floats, and three bytes of sRGB."""


def point_levels(points: Surface, first: int = 20_000) -> list[bytes]:
    """Return colored points in levels, in an order drawn with a fixed seed; `first` points in the first level.

    Each level has twice the points of the one before: first all their places, then all their colors.
    """
    order = np.random.default_rng(0).permutation(len(points.vertices))[:4_000_000]  # 60 MB
    cuts = [first * (2**level - 1) for level in range(1, 30) if first * (2**level - 1) < len(order)]
    return [
        points.vertices[part].astype("<f4").tobytes() + points.colors[part].tobytes()
        for part in np.split(order, cuts)
        if len(part)
    ]


# Resources of the page. A request names a number, never a file, so it cannot reach files outside OUT.

logger = logging.getLogger("sfm_app")

SMALL_PX, LARGE_PX = 320, 2400
"""Longer sides of the pictures in the table, and of those opened by a click. By hand."""
HTML, JPEG, GLB, BYTES = "text/html; charset=utf-8", "image/jpeg", "model/gltf-binary", "application/octet-stream"
NUMBERED = re.compile(r"/(pictures|photos|points)/([0-9]{1,9})")


@dataclass(frozen=True, slots=True)
class Resource:
    """Answer to a request."""

    kind: str
    content: bytes | Path


@dataclass
class RunResources:
    """The page of a run, and the files that it loads."""

    contents: RunContents
    names: list[str]
    """Names of the photos in the order of the page's rows."""
    points: Model | None
    """Points and cameras; None if no photo is placed."""
    lock: Lock = field(default_factory=Lock)
    """Held while a shared resource is computed."""
    most_bytes: int = MOST_GLB_BYTES
    """Larger models have a lighter one."""
    make_light: Callable[[RunContents], bytes] = light_model

    @cached_property
    def page(self) -> bytes:
        """The page as HTML."""
        pictures = {name: f"pictures/{number}" for number, name in enumerate(self.names)}
        return render_page(self.contents, LargeParts(pictures, self.view(), is_served=True)).encode("utf-8")

    @cached_property
    def levels(self) -> list[bytes]:
        """The points from coarse to fine."""
        return point_levels(self.points.surface) if self.points is not None else []

    @cached_property
    def light(self) -> bytes:
        """The model with smaller pages of texture."""
        return self.make_light(self.contents)

    def find(self, address: str) -> Resource | None:
        """Return the resource at the path of a request, with or without a query; None if there is none."""
        path = address.partition("?")[0]
        if path == "/":
            return Resource(HTML, self.page)
        if path == "/model.glb":
            model = model_file(self.contents)
            return Resource(GLB, model) if model is not None else None
        if path == "/light.glb":
            return self._find_light()
        numbered = NUMBERED.fullmatch(path)
        return self._find_numbered(numbered[1], int(numbered[2])) if numbered else None

    def _find_light(self) -> Resource | None:
        if not self._is_large():
            return None
        try:
            with self.lock:
                return Resource(GLB, self.light)
        except UNREADABLE as err:  # the page loads the full model
            logger.info("there is no lighter model", exc_info=err)
            return None

    def _find_numbered(self, kind: str, number: int) -> Resource | None:
        if kind == "points":
            return Resource(BYTES, self.levels[number]) if number < len(self.levels) else None
        if number >= len(self.names):
            return None
        side = SMALL_PX if kind == "pictures" else LARGE_PX
        jpeg = small_jpeg(self.contents.run.workspace.photos / self.names[number], side)
        return Resource(JPEG, jpeg) if jpeg else None

    def _is_large(self) -> bool:
        model = model_file(self.contents)
        return model is not None and model.stat().st_size > self.most_bytes

    def view(self) -> dict[str, Json] | None:
        """Return the data of the 3D view, with addresses instead of model and points."""
        if self.points is None:
            return None
        models = ["model.glb"] if model_file(self.contents) is not None else []
        large: dict[str, Json] = {
            "models": ["light.glb", *models] if self._is_large() else models,
            "levels": [len(level) // POINT_BYTES for level in self.levels],
            "photos": "photos",
            "out": shlex.quote(str(self.contents.run.workspace.root)),
        }
        return large | view_frame(self.contents, self.points, self.names)


def read_resources(run: RunContext) -> RunResources:
    """Return the resources of a run, with its page rendered."""
    contents = read_run(run)
    resources = RunResources(contents, photo_names(contents), view_points(contents))
    _ = resources.page
    return resources


# The server listens on the loopback address. The name of an internet page can point there, too (DNS rebinding), and its
# scripts would read the answers: so requests have to name the loopback address as their host. At another address, any
# name may be right, and every request has to bring the token: first in its query, then in the cookie of the answer.

FORBID_FRAMES = {"Content-Security-Policy": "frame-ancestors 'none'"}
"""No other page may embed an answer."""

RANGE = re.compile(r"bytes=([0-9]{0,99})-([0-9]{0,99})", re.IGNORECASE)


def asked_range(header: str, size: int) -> range | None:
    """Return the bytes that a Range header asks for; empty outside the file, None without one well-formed range."""
    first, last = found.groups() if (found := RANGE.fullmatch(header)) else ("", "")
    if not first:
        return range(max(0, size - int(last)), size) if last else None
    if last and int(last) < int(first):
        return None
    return range(size)[int(first) : int(last) + 1 if last else size]


class ViewServer(ThreadingTCPServer):
    """Serves the page of one run. An HTTPServer would ask the network for the name of this machine."""

    daemon_threads = True
    allow_reuse_address = not lacks(Ability.REUSED_PORTS)

    def __init__(self, resources: RunResources, port: int, host: str = "") -> None:
        self.resources = resources
        self.host = host or LOOPBACK
        self.token = secrets.token_urlsafe() if host else ""
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((self.host, port), ViewHandler)

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self.server_address[1])

    @property
    def address(self) -> str:
        """Address of the page, with the token; that of this machine if it listens at all addresses."""
        # a name that the user gave stays, unless it stands for all addresses
        listens = str(self.server_address[0])
        return page_address(listens if listens in ("0.0.0.0", "::") else self.host, self.port, self.token)  # noqa: S104

    @property
    def cookie(self) -> str:
        """Name and value of the cookie; browsers send the cookies of all ports of a machine."""
        return f"sfm-app-{self.port}={self.token}"

    @property
    def hosts(self) -> tuple[str, ...]:
        """Allowed hosts of requests."""
        names = (LOOPBACK, "localhost")
        return (*(f"{name}:{self.port}" for name in names), *(names if self.port == 80 else ()))

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002 - the base class gives it
        """Note in the log that a request failed: mostly, the browser has left."""
        logger.debug("a request of %s failed", client_address, exc_info=True)


class ViewHandler(BaseHTTPRequestHandler):
    """Answers one browser."""

    server: ViewServer
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "sfm-app", ""
    timeout = 60.0

    def do_GET(self) -> None:
        """Send the resource at the address."""
        self._answer()

    def do_HEAD(self) -> None:
        """Send the headers of the resource at the address."""
        self._answer()

    def log_message(self, format: str, *values: Any) -> None:  # noqa: A002 - the name that the base class gives it
        """Note a request in the log, without its token."""
        logger.debug("%s", re.sub(r"\?\S*", "", format % values))

    def _answer(self) -> None:
        if self.server.token:
            if not self._has_token():
                self._refuse(HTTPStatus.FORBIDDEN, "Open the address that sfm-app view has printed, with its token.")
                return
        elif self.headers.get_all("Host", []) not in [[host] for host in self.server.hosts]:
            self._refuse(HTTPStatus.FORBIDDEN, "This page is only for the machine that serves it.")
            return
        resource = self.server.resources.find(self.path)
        if resource is None:
            self._refuse(HTTPStatus.NOT_FOUND, "There is nothing at this address.")
        else:
            cookie = {"Set-Cookie": f"{self.server.cookie}; Path=/; HttpOnly; SameSite=Strict"}
            self._send(HTTPStatus.OK, resource, cookie if self.server.token else {})

    def _has_token(self) -> bool:
        queries = parse_qs(self.path.partition("?")[2]).get("token", [])
        cookies = [part.strip() for part in self.headers.get("Cookie", "").split(";")]
        pairs = [*((text, self.server.token) for text in queries), *((text, self.server.cookie) for text in cookies)]
        return any(hmac.compare_digest(given.encode("utf-8"), known.encode("utf-8")) for given, known in pairs)

    def _refuse(self, status: HTTPStatus, text: str) -> None:
        self.close_connection = True
        self._send(status, Resource("text/plain; charset=utf-8", text.encode("utf-8")), {})

    def _send(self, status: HTTPStatus, resource: Resource, more: dict[str, str]) -> None:
        content = resource.content
        headers = {**HEADERS, **FORBID_FRAMES, **more, "Content-Type": resource.kind, "Accept-Ranges": "bytes"}
        with content.open("rb") if isinstance(content, Path) else io.BytesIO(content) as file:
            if isinstance(content, Path):
                state = os.fstat(file.fileno())
                headers["ETag"] = f'"{state.st_mtime_ns:x}-{state.st_size:x}"'
                headers["Last-Modified"] = formatdate(state.st_mtime, usegmt=True)
            size = file.seek(0, os.SEEK_END)
            part = self._asked_range(size, headers) if status == HTTPStatus.OK else None
            if part is not None:
                status = HTTPStatus.PARTIAL_CONTENT if part else HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE
                headers["Content-Range"] = f"bytes {f'{part.start}-{part.stop - 1}' if part else '*'}/{size}"
            sent = range(size) if part is None else part
            self.send_response(status)
            for name, value in {**headers, "Content-Length": str(len(sent))}.items():
                self.send_header(name, value)
            self.end_headers()
            if sent and self.command != "HEAD":
                file.seek(sent.start)  # sendfile seeks to no offset of 0
                self.connection.sendfile(file, sent.start, len(sent))

    def _asked_range(self, size: int, headers: dict[str, str]) -> range | None:
        """Return the bytes that the request asks for; None for all, as when the file is not that of If-Range."""
        same = self.headers.get("If-Range") in (None, headers.get("ETag"), headers.get("Last-Modified"))
        return asked_range(self.headers.get("Range", ""), size) if same and self.command == "GET" else None


def open_server(resources: RunResources, port: int = 0, host: str = "") -> ViewServer:
    """Start to listen, and return the server; port 0 is any free one, ConfigError for one that cannot be used."""
    with explain_ports(host or LOOPBACK, port):
        return ViewServer(resources, port, host)


def serve_run(run: RunContext, port: int, started: Callable[[str], None], host: str = "") -> None:
    """Serve the page of a run until Ctrl-C; `started` is called with its address. Port 0 is any free one."""
    run.progress.say("preparing the page")
    with open_server(read_resources(run), port, host) as server:
        try:
            started(server.address)
            server.serve_forever()
        except KeyboardInterrupt:
            logger.info("the view has ended")
