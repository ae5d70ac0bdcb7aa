"""`sfm-app view`: a server for the browsers of this machine."""

import errno
import logging
import os
import re
import shlex
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import ThreadingTCPServer
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ConfigError
from sfm_app.numerical import Json
from sfm_app.operating_system import Ability, lacks
from sfm_app.report.contents import UNREADABLE, RunContents
from sfm_app.report.findings import photo_names, picture
from sfm_app.report.page import LargeParts, read_run, render_page
from sfm_app.report.scene_view import MOST_GLB_BYTES, light_model, model_file, view_frame, view_points
from sfm_app.runtime.context import RunContext
from sfm_app.types import Model, Surface

# Points in levels, from a coarse sample of the whole scene to all of them.

FIRST_LEVEL = 20_000
"""Points of the first level; each later one has twice as many as the one before it. Chosen by hand: 300 kB."""
MOST_SERVED = 4_000_000
"""Points of all levels together: 60 MB."""


@dataclass(frozen=True, slots=True, eq=False)
class PointLevels:
    """Points in an order in which every beginning is spread over the scene."""

    places: NDArray[np.float32]
    """(N, 3)"""
    colors: NDArray[np.uint8]
    """(N, 3) sRGB"""
    cuts: Sequence[int]
    """Where each level begins, and the end of the last."""

    @property
    def counts(self) -> list[int]:
        """Points of each level."""
        return [end - start for start, end in zip(self.cuts[:-1], self.cuts[1:], strict=True)]

    def pack(self, level: int) -> bytes:
        """Return a level as bytes: x, y, z of all its points as little-endian floats, then their colors.

        Args:
            level: from 0.

        Raises:
            IndexError: there is no such level.
        """
        if not 0 <= level < len(self.cuts) - 1:
            raise IndexError(f"there is no level {level}")
        part = slice(self.cuts[level], self.cuts[level + 1])
        return self.places[part].astype("<f4").tobytes() + self.colors[part].tobytes()


def point_levels(points: Surface) -> PointLevels:
    """Return the points of a scene in levels, in an order drawn with a fixed seed.

    Args:
        points: with colors.
    """
    order = np.random.default_rng(0).permutation(len(points.vertices))[:MOST_SERVED]
    cuts = [0]
    while cuts[-1] < len(order):
        cuts.append(min(len(order), cuts[-1] + FIRST_LEVEL * 2 ** (len(cuts) - 1)))
    return PointLevels(points.vertices[order].astype(np.float32), points.colors[order], cuts)


# What the page of a run is served with. A request names a number, never a file, so it cannot name one outside OUT.

logger = logging.getLogger("sfm_app")

SMALL_PX, LARGE_PX = 320, 2400
"""Longer sides of the pictures in the table, and of those that are asked for by a click."""
HTML, JPEG, GLB, BYTES = "text/html; charset=utf-8", "image/jpeg", "model/gltf-binary", "application/octet-stream"
NUMBERED = re.compile(r"/(pictures|photos|points)/([0-9]{1,9})")
"""Addresses of what there are many of."""


@dataclass(frozen=True, slots=True)
class Resource:
    """What a request is answered with."""

    kind: str
    """Its media type."""
    content: bytes | Path
    """A file is sent piece by piece."""


@dataclass
class RunResources:
    """The page of a run, and what it loads."""

    contents: RunContents
    names: list[str]
    """Names of the photos in order of the page's rows."""
    points: Model | None
    """Points and cameras; None where no photo has a place."""
    lock: Lock = field(default_factory=Lock)
    """Held while something is made that several requests may ask for."""

    @cached_property
    def page(self) -> bytes:
        """The page as HTML."""
        pictures = {name: f"pictures/{number}" for number, name in enumerate(self.names)}
        return render_page(self.contents, LargeParts(pictures, self._view(), is_served=True)).encode("utf-8")

    @cached_property
    def levels(self) -> PointLevels | None:
        """The points from coarse to fine."""
        return point_levels(self.points.surface) if self.points is not None else None

    @cached_property
    def light(self) -> bytes:
        """The model with smaller pages of texture."""
        return light_model(self.contents)

    def find(self, address: str) -> Resource | None:
        """Return what lies at an address of the page; None where there is nothing.

        Args:
            address: the path of a request, with or without a query.
        """
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
        """Return the lighter model where one is needed; None where it cannot be made, too."""
        if not self._is_large():
            return None
        try:
            with self.lock:
                return Resource(GLB, self.light)
        except UNREADABLE as err:  # the page goes on to the full model
            logger.info("there is no lighter model", exc_info=err)
            return None

    def _find_numbered(self, kind: str, number: int) -> Resource | None:
        if kind == "points":
            levels = self.levels
            return Resource(BYTES, levels.pack(number)) if levels and number < len(levels.counts) else None
        if number >= len(self.names):
            return None
        side = SMALL_PX if kind == "pictures" else LARGE_PX
        jpeg = picture(self.contents.run.workspace.photos / self.names[number], side)
        return Resource(JPEG, jpeg) if jpeg else None

    def _is_large(self) -> bool:
        """Return whether the model is so large that a lighter one is shown first."""
        model = model_file(self.contents)
        return model is not None and model.stat().st_size > MOST_GLB_BYTES

    def _view(self) -> dict[str, Json] | None:
        """Return what the 3D view needs, with addresses instead of data."""
        if self.points is None or self.levels is None:
            return None
        models = ["model.glb"] if model_file(self.contents) is not None else []
        large: dict[str, Json] = {
            "models": ["light.glb", *models] if self._is_large() else models,
            "levels": self.levels.counts,
            "photos": "photos",
            "out": shlex.quote(str(self.contents.run.workspace.root)),
        }
        return large | view_frame(self.contents, self.points, self.names)


def read_resources(run: RunContext) -> RunResources:
    """Return what the page of a run is served with, its page made.

    Args:
        run: with its output folder.

    Raises:
        InputError: the folder holds no run.
    """
    contents = read_run(run)
    found = RunResources(contents, photo_names(contents), view_points(contents))
    _ = found.page
    return found


# A server for the browsers of this machine.
#
# It listens on the loopback address only. A page on the internet can let its own name point there (DNS rebinding),
# and its scripts would then read the answers: so requests are refused unless they name the loopback address as
# their host.

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
