"""The server of the studio: projects as JSON, uploads, pictures, and the files of the page.

It listens on the loopback address. Every request needs the token (first in the address, then in a cookie), and names
this machine as its host, so that no page of the internet reaches it by a name that points here. Names in addresses are
compared with the names of projects and photos, and never made into paths.
"""

import asyncio
import contextlib
import hmac
import mimetypes
import secrets
import shutil
import socket
from collections.abc import AsyncIterator, Callable
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import jinja2
import uvicorn
from markupsafe import Markup
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from sfm_app.errors import ConfigError, SfmError
from sfm_app.operating_system import Ability, lacks
from sfm_app.photos.decode import small_jpeg
from sfm_app.photos.files import resolve_file
from sfm_app.report.listening import HEADERS, LOOPBACK, explain_ports, page_address
from sfm_app.studio.jobs import Jobs, Progress
from sfm_app.studio.projects import (
    DEPTHS,
    DRAFT,
    IDLE,
    LONGEST_NAME,
    MODEL,
    PAUSED,
    QUEUED,
    RUNNING,
    VIEW,
    VIEW_DATA,
    Project,
    Projects,
)

ASSETS = Path(__file__).parent / "assets"
SHARED = Path(__file__).parents[1] / "report" / "assets"
"""Styles and scripts of the report, which the studio uses, too."""
TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(SHARED), autoescape=True, undefined=jinja2.StrictUndefined
)
LOCAL_NAMES = (LOOPBACK, "localhost")
FREE_BYTES = 2 * 2**30
"""Disk that uploads leave free: a run needs some. Chosen by hand."""
SMALL_PX, LARGE_PX = 320, 2400
"""Longer sides of pictures in the list, and of those in the 3D view. Chosen by hand."""
NO_PICTURE = (
    b'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 64 48"><path d="M20 12h24v24H20zM28 18v12l9-6z" fill="none" '
    b'stroke="#78716c" stroke-linejoin="round"/></svg>'
)
"""A picture of what the browser cannot show, such as a video."""
RESULTS = ("headline", "problem", "warnings", "facts", "minutes", "has_view", "has_model")
STOPPED = {"pause": PAUSED, "cancel": IDLE}
FORMATS = ("glb", "obj", "stl", "usdz", "ply", "laz", "splat", "blender")
VIEW_FILES = {
    "three.js": f"{VIEW}/three.js", "light.glb": f"{VIEW}/light.glb",
    "model.glb": f"{MODEL}/model.glb",
}  # fmt: skip
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self' blob:; "
    "frame-src 'self'; frame-ancestors 'self'; base-uri 'none'; form-action 'self'"
)


class Gate:
    """Lets only requests pass that know the token, and come from the studio's own page."""

    def __init__(self, app: ASGIApp, token: str, port: int, any_host: bool) -> None:
        self.app, self.token, self.any_host = app, token, any_host
        self.cookie = f"sfm-app-studio-{port}"
        self.hosts = {f"{name}:{port}" for name in LOCAL_NAMES}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer or refuse a request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request = Request(scope, receive)
        answer = self._refuse(request) or self._welcome(request)
        await (answer or self.app)(scope, receive, send)

    def _refuse(self, request: Request) -> Response | None:
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if not self.any_host and host not in self.hosts:
            return Response("This page is only for the machine that serves it.", 403)
        if origin is not None and urlsplit(origin).netloc != host:
            return Response("Another page has asked for this.", 403)
        known = (request.cookies.get(self.cookie, ""), request.query_params.get("token", ""))
        if not any(hmac.compare_digest(text.encode(), self.token.encode()) for text in known):
            return Response("Open the address that sfm-app studio has printed, with its token.", 403)
        return None

    def _welcome(self, request: Request) -> Response | None:
        """Exchange the token of the address for a cookie, so that it stays in no history."""
        if "token" not in request.query_params:
            return None
        answer = RedirectResponse(request.url.path, 303)
        answer.set_cookie(self.cookie, self.token, httponly=True, samesite="strict", path="/")
        return answer


class Studio:
    """Answers the page."""

    def __init__(self, folder: Path) -> None:
        self.projects = Projects(folder)
        self.jobs = Jobs(self.projects)
        self.background = set[asyncio.Task[None]]()
        self.pictures = asyncio.Semaphore(1)

    def project(self, request: Request) -> Project:
        """Return the project that a request names; 404 without one."""
        project = self.projects.find(request.path_params["project"])
        if project is None:
            raise HTTPException(404, "there is no such project")
        return project

    # what there is

    async def list(self, _: Request) -> Response:
        """Return all projects."""
        return JSONResponse(await run_in_threadpool(lambda: [self._summary(project) for project in self.projects]))

    def _summary(self, project: Project) -> dict[str, Any]:
        result = project.result()
        return {
            "name": project.name, "title": project.title, "state": project.wanted,
            "headline": result.get("headline", ""), "has_picture": bool(result.get("names")),
        }  # fmt: skip

    async def show(self, request: Request) -> Response:
        """Return a project: its state, progress, results and settings."""
        project = self.project(request)
        shown, result, settings = self.jobs.progress.get(project.name, Progress()), project.result(), project.settings()
        photos = await run_in_threadpool(project.photos)
        return JSONResponse({
            "title": project.title, "state": project.wanted, "source": str(project.source) if project.is_linked else "",
            "folder": str(project.root), "quality": settings.get("quality", "normal"),
            "command": project.command(photos),
            "markers": settings.get("scale", {}).get("markers", ""),
            "sizes": settings.get("scale", {}).get("distances", []),
            "level": settings.get("scale", {}).get("level", []), "depths": shown.depths,
            "stage": shown.stage, "done": shown.done, "total": shown.total,
            "minutes_left": shown.minutes, "views": shown.views, "messages": [*shown.messages],
            "failure": shown.failure, "hint": shown.hint, "photos": len(photos),
            **{key: result.get(key) for key in RESULTS},
        })  # fmt: skip

    async def photos(self, request: Request) -> Response:
        """Return the photos of a project, each with its state and reason."""
        return JSONResponse(await run_in_threadpool(self.project(request).rows))

    async def thumb(self, request: Request) -> Response:
        """Return a picture of a photo, small unless a large one is wanted; an empty one where none can be shown."""
        project, name = self.project(request), request.path_params["name"]
        place = resolve_file(project.source, name)
        if isinstance(place, str):
            raise HTTPException(404, f"there is no such photo: {place}")
        return await self._picture(place, LARGE_PX if "large" in request.query_params else SMALL_PX, upright=True)

    async def _picture(self, path: Path, side: int, *, upright: bool = False) -> Response:
        async with self.pictures:  # all at once would hold up everything else
            jpeg = await run_in_threadpool(partial(small_jpeg, path, side, upright=upright))
        kind = "image/jpeg" if jpeg else "image/svg+xml"
        return Response(jpeg or NO_PICTURE, media_type=kind, headers={"Cache-Control": "private, max-age=3600"})

    # what the user wants

    async def create(self, request: Request) -> Response:
        """Make a project."""
        values = await _values(request)
        project = self.projects.create(str(values.get("name", "")), str(values.get("source", "")))
        if project.is_linked:
            self._check_soon(project)
        return JSONResponse({"name": project.name}, 201)

    async def delete(self, request: Request) -> Response:
        """Remove a project with its files."""
        project = self.project(request)
        if self.jobs.is_at_work(project):
            raise HTTPException(409, "it is at work: stop it first")
        await run_in_threadpool(self.projects.delete, project)
        return JSONResponse({})

    async def upload(self, request: Request) -> Response:
        """Take a photo, a video or a ZIP archive."""
        project, name = self.project(request), request.path_params["name"]
        if project.is_linked:
            raise HTTPException(409, "the photos of this project lie in a folder of this machine: add them there")
        async with _uploaded(request, project) as draft:
            kept = await run_in_threadpool(project.keep, draft, name)
        return JSONResponse({"name": kept}, 201)

    async def mask(self, request: Request) -> Response:
        """Return, take or remove the mask of a photo."""
        project, name = self.project(request), request.path_params["name"]
        place = project.mask(name)
        if request.method == "GET":
            return _file(place)
        if request.method == "PUT":
            async with _uploaded(request, project) as draft:
                place.parent.mkdir(parents=True, exist_ok=True)
                draft.replace(place)
        else:
            place.unlink(missing_ok=True)
        project.note_masks()
        return JSONResponse({})

    async def remove(self, request: Request) -> Response:
        """Take photos out of a project."""
        project, values = self.project(request), await _values(request)
        project.remove([str(name) for name in values.get("names", ())])
        return JSONResponse({})

    async def check(self, request: Request) -> Response:
        """Find out which photos are usable; a finished model stays as it is until the next run."""
        project = self.project(request)
        if project.wanted not in (RUNNING, QUEUED) and not project.result().get("has_view"):
            self._check_soon(project)
        return JSONResponse({}, 202)

    def _check_soon(self, project: Project) -> None:
        task = asyncio.create_task(self.jobs.check(project))
        self.background.add(task)
        task.add_done_callback(self.background.discard)

    async def change(self, request: Request) -> Response:
        """Change the title, the quality, the side of markers, the size between two places, or what is level."""
        project, values = self.project(request), await _values(request)
        if "title" in values:
            project.note(title=str(values["title"])[:LONGEST_NAME])
        try:
            if "quality" in values:
                project.change("", "quality", values["quality"])
            if "markers" in values:
                project.change("scale", "markers", values["markers"])
            for name, key in (("size", "distances"), ("level", "level")):
                if name in values:
                    project.change("scale", key, [values[name]] if values[name] else [])
                    self.jobs.start(project)
        except ConfigError as err:  # its hint is for the command line
            raise HTTPException(400, str(err)) from err
        return JSONResponse({})

    async def act(self, request: Request) -> Response:
        """Start, pause or stop the run of a project."""
        project, action = self.project(request), request.path_params["action"]
        if action == "start":
            self.jobs.start(project)
        elif action in STOPPED:
            self.jobs.stop(project, STOPPED[action])
        else:
            raise HTTPException(404, "there is nothing at this address")
        return JSONResponse({})

    async def export(self, request: Request) -> Response:
        """Write the model in a format, and return the address of the file."""
        project, values = self.project(request), await _values(request)
        if values.get("format") not in FORMATS:
            raise HTTPException(400, f"no format is named so; known: {', '.join(FORMATS)}")
        box = values.get("box")
        if (
            box is not None
            and [[type(value) in (int, float) for value in corner] for corner in box] != [[True] * 3] * 2
        ):
            raise HTTPException(400, "a box is two corners of three numbers")
        line = await self.jobs.export(project, values["format"], box)
        if line.get("end") != "done":
            return JSONResponse({"message": line.get("message", ""), "hint": line.get("hint", "")}, 400)
        return JSONResponse({"file": line["file"]})

    # files

    async def download(self, request: Request) -> Response:
        """Return an exported file, or the report."""
        project, name = self.project(request), request.path_params["name"]
        if name == "report.html":
            return _file(project.out / name, download=f"{project.title}.html")
        files = {path.relative_to(project.exports).as_posix(): path for path in project.exports.rglob("*")}
        return _file(files.get(name), download=Path(name).name)

    async def view(self, request: Request) -> Response:
        """Return a file of the 3D view: its page, points, pictures and models."""
        project = self.project(request)
        kind, _, number = str(request.path_params["name"]).partition("/")
        if not kind:
            return HTMLResponse(await run_in_threadpool(_view_page, project))
        if kind in VIEW_FILES:
            return _file(project.root / VIEW_FILES[kind])
        if not number.isdecimal() or len(number) > 6:
            raise HTTPException(404, "there is nothing at this address")
        if kind in ("points", DEPTHS):
            return _file(project.view / kind / (number if kind == "points" else f"{number}.jpg"))
        result = project.result()
        names = result.get("names", [])
        if kind not in ("pictures", "photos") or int(number) >= len(result.get("photos", ())):
            raise HTTPException(404, "there is nothing at this address")
        if int(number) >= len(names):  # it is left out
            return Response(NO_PICTURE, media_type="image/svg+xml")
        return await self._picture(
            project.out / "photos" / names[int(number)], SMALL_PX if kind == "pictures" else LARGE_PX
        )


def _view_page(project: Project) -> str:
    """Return the page of the 3D view: scripts and page are of one version, whenever the data was written."""
    try:
        data = (project.view / VIEW_DATA).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise HTTPException(404, "there is nothing to see yet") from None
    return TEMPLATES.get_template("studio_view.html.jinja").render(data=Markup(data), studio=True)  # noqa: S704 - escaped


async def _values(request: Request) -> dict[str, Any]:
    values = await request.json()
    if not isinstance(values, dict):
        raise HTTPException(400, "the request is not understood")
    return values


@contextlib.asynccontextmanager
async def _uploaded(request: Request, project: Project) -> AsyncIterator[Path]:
    """Write the body of a request into a file, which goes unless it is moved."""
    size = int(request.headers.get("content-length", -1))
    if size < 0:
        raise HTTPException(411, "the size of the file is missing")
    if shutil.disk_usage(project.root).free < size + FREE_BYTES:
        raise HTTPException(507, "the disk is full: remove files or other projects")
    draft = project.root / f"{DRAFT}{secrets.token_hex(8)}"
    try:
        with draft.open("xb") as file:
            async for part in request.stream():
                size -= len(part)
                if size < 0:
                    raise HTTPException(413, "the file is larger than announced")
                file.write(part)
        yield draft
    finally:
        draft.unlink(missing_ok=True)


def _file(path: Path | None, download: str = "") -> Response:
    if path is None or not path.is_file():
        raise HTTPException(404, "there is nothing at this address")
    kind = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    kind = "model/gltf-binary" if path.suffix == ".glb" else kind
    return FileResponse(path, media_type=kind, filename=download or None)


async def _page(_: Request) -> Response:
    return _file(ASSETS / "studio.html")


async def _on_error(_: Request, err: Exception) -> Response:
    if isinstance(err, HTTPException):
        return JSONResponse({"message": err.detail, "hint": ""}, err.status_code)
    if isinstance(err, SfmError):
        return JSONResponse({"message": str(err), "hint": err.hint}, 400)
    return JSONResponse({"message": "the request is not understood", "hint": ""}, 400)


def make_app(folder: Path, token: str, port: int, *, any_host: bool = False) -> Starlette:
    """Return the application; `port` is that of the Host headers that it accepts, unless any host may be right."""
    studio = Studio(folder)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        work = asyncio.create_task(studio.jobs.work())
        yield
        work.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await work

    at = "/api/projects/{project}"
    routes = [
        Route("/", _page),
        Mount("/assets", StaticFiles(directory=ASSETS)),
        Mount("/shared", StaticFiles(directory=SHARED)),
        Route("/api/projects", studio.list),
        Route("/api/projects", studio.create, methods=["POST"]),
        Route(at, studio.show),
        Route(at, studio.change, methods=["PATCH"]),
        Route(at, studio.delete, methods=["DELETE"]),
        Route(f"{at}/photos", studio.photos),
        Route(f"{at}/photos", studio.remove, methods=["DELETE"]),
        Route(f"{at}/photos/{{name:path}}", studio.thumb),
        Route(f"{at}/files/{{name:path}}", studio.upload, methods=["PUT"]),
        Route(f"{at}/masks/{{name:path}}", studio.mask, methods=["GET", "PUT", "DELETE"]),
        Route(f"{at}/check", studio.check, methods=["POST"]),
        Route(f"{at}/exports", studio.export, methods=["POST"]),
        Route(f"{at}/exports/{{name:path}}", studio.download),
        Route(f"{at}/view/{{name:path}}", studio.view),
        Route(f"{at}/{{action}}", studio.act, methods=["POST"]),
    ]
    gate = Middleware(Gate, token=token, port=port, any_host=any_host)
    handlers: dict[Any, Any] = {HTTPException: _on_error, SfmError: _on_error, ValueError: _on_error}
    return Starlette(
        routes=routes, middleware=[Middleware(Headers), gate], exception_handlers=handlers, lifespan=lifespan
    )


class Headers:
    """Adds headers to every answer, unless it has them."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""

        async def add(message: Any) -> None:
            if message["type"] == "http.response.start":
                known = {name.lower() for name, _ in message["headers"]}
                wanted = HEADERS | {"Content-Security-Policy": POLICY}
                extra = {name.lower().encode(): value.encode() for name, value in wanted.items()}
                message["headers"] += [(name, value) for name, value in extra.items() if name not in known]
            await send(message)

        await self.app(scope, receive, add)


def serve_studio(folder: Path, port: int, host: str, started: Callable[[str], None]) -> None:
    """Serve the studio until Ctrl-C; `started` gets the address of the page. ConfigError where it cannot listen."""
    token, place = secrets.token_urlsafe(), host or LOOPBACK
    family = socket.AF_INET6 if ":" in place else socket.AF_INET
    with socket.socket(family) as listener:
        if not lacks(Ability.REUSED_PORTS):  # a restart may take the port of before
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with explain_ports(place, port):
            listener.bind((place, port))
            listener.listen()  # a browser may be faster than the rest
        used = listener.getsockname()[1]
        app = make_app(folder, token, used, any_host=bool(host))
        config = uvicorn.Config(
            app, log_level="warning", access_log=False, server_header=False, lifespan="on", timeout_graceful_shutdown=3
        )
        started(page_address(place, used, token))
        with contextlib.suppress(KeyboardInterrupt):
            uvicorn.Server(config).run([listener])
